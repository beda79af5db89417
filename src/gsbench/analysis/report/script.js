// The slider of a pair of crops moves the cut between its two images; without this script the cut stays in the middle.
for (const slider of document.querySelectorAll(".crop input")) {
  const pair = slider.closest(".crop").querySelector(".pair");
  slider.hidden = false;
  slider.addEventListener("input", () => {
    pair.style.setProperty("--cut", slider.value + "%");
    slider.setAttribute("aria-valuetext", slider.value + " % " + slider.dataset.first);
  });
}
// What is folded away on the screen belongs on paper.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => (part.open = true)));
