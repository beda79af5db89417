// A round of votes. Answers stay in this browser (localStorage) until they are saved as a file; nothing is sent.
"use strict";
const { round, showings } = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);
const place = `gsbench-vote-${round}`;
const FLICKER_MS = 600; // below three changes a second, which is safe for photosensitive people
const ZOOMS = [1, 1.5, 2, 3, 4, 6, 8];
const ANSWERS = { ArrowLeft: "left", ArrowRight: "right", ArrowDown: "same" };

let kept = true; // whether this browser keeps answers over a reload
let state = read() || fresh();
let view = { zoom: 1, x: 0.5, y: 0.5 }; // x and y: 0 at the left and upper edge, 1 at the right and lower one
let ready = false; // whether the pictures of this showing are there
let begun = 0; // when they were there
let timer = 0;

function fresh() {
  const bytes = crypto.getRandomValues(new Uint8Array(8));
  const person = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return { person, name: "", started: false, finished: "", votes: [] };
}

function read() {
  try {
    return JSON.parse(localStorage.getItem(place));
  } catch {
    kept = false;
    return null;
  }
}

function keep() {
  try {
    localStorage.setItem(place, JSON.stringify(state));
  } catch {
    kept = false;
  }
}

function show() {
  const done = state.votes.length;
  const part = !state.started ? "start" : done < showings.length ? "round" : "end";
  for (const name of ["start", "round", "end"]) find(name).hidden = name !== part;
  stopFlicker();
  if (part === "round") showPair(done);
  else find(part).querySelector("h1").focus();
  if (part === "start") find("name").focus();
}

async function showPair(number) {
  const showing = showings[number];
  ready = false;
  setView(1, 0.5, 0.5);
  find("progress").textContent = `${number + 1} of ${showings.length}: which is nearer to the photograph?`;
  find("bar").value = number;
  find("back").disabled = number === 0;
  find("problem").textContent = kept ? "" : "This browser keeps no answers: do not reload the page before you save.";
  const pictures = ["photo", "left", "right"].map((what) => find(what));
  // All three appear together, or a fast person would compare with the pictures of the pair before.
  for (const picture of pictures) picture.style.visibility = "hidden";
  for (const picture of pictures) picture.src = showing[picture.id];
  try {
    await Promise.all(pictures.map((picture) => picture.decode()));
  } catch {
    if (showings[state.votes.length] === showing) find("problem").textContent = "A picture cannot be loaded: is the folder of pictures beside this page? Reload it then.";
    return;
  }
  if (showings[state.votes.length] !== showing) return;
  document.body.style.setProperty("--aspect", pictures[0].naturalWidth / pictures[0].naturalHeight);
  for (const picture of pictures) picture.style.visibility = "";
  ready = true;
  begun = performance.now();
  const next = showings[number + 1];
  if (next) for (const what of ["photo", "left", "right"]) new Image().src = next[what];
}

function answer(word) {
  if (!ready) return;
  ready = false;
  const seconds = Math.round(performance.now() - begun) / 1000;
  state.votes.push({ showing: showings[state.votes.length].id, answer: word, seconds });
  if (state.votes.length === showings.length) state.finished = new Date().toISOString().slice(0, 19) + "Z";
  keep();
  show();
}

function back() {
  if (!state.votes.length) return;
  state.votes.pop();
  keep();
  show();
}

function setView(zoom, x, y) {
  const inside = (part) => Math.min(1, Math.max(0, part));
  view = { zoom, x: inside(x), y: inside(y) };
  const style = document.body.style;
  style.setProperty("--zoom", zoom);
  style.setProperty("--x", -100 * view.x * (zoom - 1));
  style.setProperty("--y", -100 * view.y * (zoom - 1));
  document.body.classList.toggle("zoomed", zoom > 1);
}

// One step of zoom that leaves the point at (px, py), parts of a panel, where it is.
function zoomBy(step, px = 0.5, py = 0.5) {
  const zoom = ZOOMS[Math.min(ZOOMS.length - 1, Math.max(0, ZOOMS.indexOf(view.zoom) + step))];
  const moved = (part, at) => (zoom > 1 ? (((at + part * (view.zoom - 1)) / view.zoom) * zoom - at) / (zoom - 1) : 0.5);
  setView(zoom, moved(view.x, px), moved(view.y, py));
}

function moveBy(dx, dy) {
  if (view.zoom > 1) setView(view.zoom, view.x + dx / (view.zoom - 1), view.y + dy / (view.zoom - 1));
}

function flick() {
  const hidden = document.querySelector(".side.under");
  for (const side of document.querySelectorAll(".side")) side.classList.toggle("under", hidden ? side !== hidden : side.querySelector("#right") !== null);
}

function stopFlicker() {
  clearInterval(timer);
  timer = 0;
  document.body.classList.remove("flicker");
  for (const side of document.querySelectorAll(".side")) side.classList.remove("under");
  find("flick").setAttribute("aria-pressed", "false");
}

function toggleFlicker() {
  if (document.body.classList.contains("flicker")) return stopFlicker();
  document.body.classList.add("flicker");
  find("flick").setAttribute("aria-pressed", "true");
  flick();
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) timer = setInterval(flick, FLICKER_MS);
}

function save() {
  const { person, name, finished, votes } = state;
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify({ round, person, name, finished, votes })], { type: "application/json" }));
  link.download = `votes-${round}-${person.slice(0, 6)}.json`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  find("saved").textContent = `Saved as ${link.download}, where your browser puts downloads.`;
}

function begin() {
  state.name = find("name").value.trim();
  state.started = true;
  keep();
  show();
}

// Returns whether the key means something here.
function press(key, shift) {
  if (!find("end").hidden) {
    if (key === "Enter") save();
    else if (key === "Backspace") back();
    else return false;
    return true;
  }
  if (find("round").hidden) {
    if (key === "Enter") begin();
    return key === "Enter";
  }
  const arrows = { ArrowLeft: [-0.2, 0], ArrowRight: [0.2, 0], ArrowUp: [0, -0.2], ArrowDown: [0, 0.2] };
  if (shift && arrows[key]) moveBy(...arrows[key]);
  else if (ANSWERS[key]) answer(ANSWERS[key]);
  else if (key === "Backspace") back();
  else if (key === "+" || key === "=") zoomBy(1);
  else if (key === "-") zoomBy(-1);
  else if (key === "0") setView(1, 0.5, 0.5);
  else if (key === "f" || key === "F") toggleFlicker();
  else if (key === " " && document.body.classList.contains("flicker")) {
    clearInterval(timer);
    flick();
  } else return false;
  return true;
}

document.addEventListener("keydown", (event) => {
  const { target, key } = event;
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (target.tagName === "INPUT" && key !== "Enter") return;
  if (target.tagName === "BUTTON" && (key === "Enter" || key === " ")) return; // the button's own
  // A key that is held down answers once.
  const repeated = event.repeat && !event.shiftKey && key !== "+" && key !== "-";
  if (repeated ? ANSWERS[key] || key === "Backspace" : press(key, event.shiftKey)) event.preventDefault();
});
document.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-key]");
  if (!button) return;
  press(button.dataset.key, false);
  button.blur(); // so that Space and Enter are keys of the page again
});
find("begin").addEventListener("click", begin);
find("save").addEventListener("click", save);
find("anew").addEventListener("click", () => {
  if (!confirm("Your answers in this browser are deleted. Have you saved them?")) return;
  state = fresh();
  keep();
  show();
});
for (const panel of document.querySelectorAll(".panel")) {
  panel.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = panel.getBoundingClientRect();
    zoomBy(event.deltaY < 0 ? 1 : -1, (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  }, { passive: false });
  panel.addEventListener("pointerdown", (event) => panel.setPointerCapture(event.pointerId));
  panel.addEventListener("pointermove", (event) => {
    if (event.buttons) moveBy(-event.movementX / panel.clientWidth, -event.movementY / panel.clientHeight);
  });
}
show();
