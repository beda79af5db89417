"""No process outlives the function that started it; on Linux this includes daemons."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import psutil
import pytest

from gsbench.errors import TrainingError
from gsbench.external.run import run_program
from tests.processes import heed_interrupts, is_running, wait_until

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="daemons get away where nobody can adopt orphans"
)
PATIENCE = 60.0  # seconds; a slow machine needs fewer

# A daemon as in Stevens: forked twice, in a session of its own, with an empty environment. It notes
# its process id.
DAEMON = """
import os, sys, time
def daemon(mark, code="import time; time.sleep(600)"):
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            os.setsid()
            os.closerange(0, 3)
            with open(mark + ".new", "w") as stream:
                stream.write(str(os.getpid()))
            os.rename(mark + ".new", mark)
            os.execve(sys.executable, [sys.executable, "-c", code], {})
        os._exit(0)
    os.wait()
    while not os.path.exists(mark):
        time.sleep(0.01)
"""
SIGNALS = (
    "import signal, time; [signal.signal(s, signal.SIG_IGN) for s in (1, 2, 15)]; time.sleep(600)"
)
FORKS = "import os, time; [os.fork() for _ in range(4)]; time.sleep(600)"


def is_gone(mark):
    """Return whether the process whose id is in the file ``mark`` ends within `PATIENCE`."""
    pid, deadline = int(mark.read_text()), time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if not is_running(pid):
            return True
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)
    return False


@pytest.mark.parametrize(
    "end, code",
    [
        ("", SIGNALS),
        ("raise SystemExit(3)", "import time; time.sleep(600)"),
        ("os.kill(os.getpid(), 9)", FORKS),
        ("time.sleep(600)", SIGNALS),
    ],
    ids=["ends", "fails", "is killed", "takes too long"],
)
def test_a_daemon_of_a_trainer_ends_with_it(tmp_path, end, code):
    program = f"{DAEMON}\ndaemon('mark', {code!r})\n{end}"
    try:
        command = [sys.executable, "-c", program]
        run_program(
            command, tmp_path / "log", tmp_path, dict(os.environ), 2.0 if "sleep" in end else None
        )
        assert not end
    except TrainingError:
        assert end
    assert is_gone(tmp_path / "mark")
    forks = [sys.executable, "-c", FORKS]
    wait_until(
        lambda: all(one.info["cmdline"] != forks for one in psutil.process_iter(["cmdline"])),
        PATIENCE,
        0.05,
    )


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_daemon_ends_with_gsbench_however_that_ends(tmp_path, sign):
    (tmp_path / "main.py").write_text(
        textwrap.dedent(f"""
        import os, sys
        from pathlib import Path
        from gsbench.external.run import run_program
        program = {DAEMON!r} + "\\ndaemon('mark')\\ntime.sleep(600)"
        here = Path({str(tmp_path)!r})
        run_program([sys.executable, "-c", program], here / "log", here, dict(os.environ), None)
        """)
    )
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "main.py")], preexec_fn=heed_interrupts
    )
    wait_until((tmp_path / "mark").exists, PATIENCE)
    parent.send_signal(sign)
    parent.wait(PATIENCE)
    assert is_gone(tmp_path / "mark")
