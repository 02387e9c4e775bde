"""``armsight serve``: its file, its child that is lost and comes back, its pages; a stub publishes what a child would."""

import configparser
import json
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from armsight.app.serve import service
from armsight.app.serve.config import ServeConfig, read_config
from armsight.app.serve.service import METRICS, Service, state_pages
from armsight.app.show.http import metrics_text
from armsight.errors import InputError
from cli_runs import assert_has, assert_rejected

ROOT = Path(__file__).parents[3]
SHOT = {"kind": "shot", "status": "ok", "age_s": 0.02, "covariance": [[9e-10, 0, 0], [0, 4e-10, 0], [0, 0, 3.6e-9]]}
#: Sends shots, then fails as its next line of the plan says: `N REASON` (exit 2 after N shots), `N silent`, `N ends`.
STUB = """
import json, pathlib, socket, sys, time
arguments = json.loads(sys.stdin.readline() or sys.exit())
plan = pathlib.Path("plan"); lines = plan.read_text().splitlines()
plan.write_text("\\n".join(lines[1:]))
count, reason = (lines or ["0 ends"])[0].split(" ", 1)
port = int(arguments[-1].rpartition(":")[2])
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for k in range(int(count)):
    shot = json.loads(sys.argv[1]) | ({"status": "missed"} if k == 1 else {})
    out.sendto(json.dumps(shot).encode(), ("127.0.0.1", port))
if reason == "silent":
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        pass
print("armsight: error: " + reason, file=sys.stderr)
sys.exit(0 if reason == "ends" else 2)
"""


@pytest.fixture
def serving(tmp_path, monkeypatch):
    """Serve a stub that does what a plan says; returns the exit code, the events and the log."""
    monkeypatch.setattr(service, "_ARMSIGHT", (sys.executable, "-S", "-c", STUB, json.dumps(SHOT)))
    monkeypatch.setattr(service, "_PAUSE_S", 0.01)
    monkeypatch.setattr(service, "_LOOK_S", 0.02)

    def serve(*plan, **options):
        (tmp_path / "plan").write_text("\n".join(plan))
        events = []
        served = Service(ServeConfig((), tmp_path, http="", log="log", **options), events.append)
        return served.run(), events, (tmp_path / "log").read_text(), served

    return serve


def test_each_loss_is_said_once_and_the_return_with_its_tries(serving):
    gone = "0 camera gone"
    code, events, log, served = serving(
        "3 camera gone", gone, gone, "0 board gone", "2 camera gone", "4 ends", retry_s=0.02
    )
    assert code == 0
    assert [each["event"] for each in events] == ["measuring", "lost", "lost", "back", "lost", "back", "ended"]
    assert [each.get("why") for each in events[1:3]] == ["camera gone", "board gone"]
    assert (events[3]["tries"], events[5]["tries"]) == (4, 1)
    assert served._next is None or served._next.poll() is not None  # none waits on
    assert log.count("lost: camera gone; trying again") == 2
    assert log.count("measure: armsight: error: camera gone") <= 2  # at most one for each loss, not for each try
    values = served.values()
    assert (values["shots_total"], values["missed_total"], values["losses_total"]) == (9, 3, 2)
    assert values["sigma_metres"] == pytest.approx(7e-5)


def test_days_of_losses_leave_one_line_each(serving):
    _, events, log, _ = serving(*(f"2 camera {k} gone" for k in range(20)), "1 ends", log_mb=0.002, log_files=2)
    assert sum(each["event"] == "lost" for each in events) == sum(each["event"] == "back" for each in events) == 20
    assert len(log) <= 2200  # the log does not grow


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a disk that is full")
def test_a_full_disk_ends_no_service_and_changes_no_exit_code(serving, tmp_path):
    (tmp_path / "log").symlink_to("/dev/full")
    (tmp_path / "plan").write_text("3 unplugged\n3 ends")
    events = []
    assert Service(ServeConfig((), tmp_path, http="", log="log"), events.append).run() == 0
    assert [each["event"] for each in events] == ["measuring", "lost", "back", "ended"]


def test_a_driver_that_falls_silent_is_started_again(serving):
    code, events, *_ = serving("2 silent", "1 ends", stale_s=2.0)  # on a busy computer a child needs a second to end
    assert code == 0
    assert [each["why"] for each in events if each["event"] == "lost"] == ["no shot for 2 s"]


def test_a_child_that_was_killed_while_it_waited_is_no_loss(serving, tmp_path):
    (tmp_path / "plan").write_text("1 ends")
    served = Service(ServeConfig((), tmp_path, http=""), (events := []).append)
    served._prepare()
    served._next.kill()
    served._next.wait()
    assert served.run() == 0
    assert [each["event"] for each in events] == ["measuring", "ended"]


def test_on_stderr_a_reason_is_said_once(serving, tmp_path, capsys):
    (tmp_path / "plan").write_text("1 camera gone\n1 ends")
    assert Service(ServeConfig((), tmp_path, http=""), lambda event: None).run() == 0
    assert capsys.readouterr().err.count("camera gone") == 1


def test_an_interrupt_ends_the_child(serving):
    threading.Timer(0.6, signal.raise_signal, (signal.SIGINT,)).start()
    before = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        serving("2 silent")
    assert time.monotonic() - before < service._END_S  # the child was not waited for in vain


def test_a_child_that_waits_ends_with_its_service():
    done = subprocess.run(service._ARMSIGHT, stdin=subprocess.DEVNULL, capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_a_board_that_is_lost_and_back_is_said_once(tmp_path):
    """And where another reason shows; also where the child that reads it begins anew meanwhile, and says so itself."""
    events = []
    served = Service(ServeConfig(("--board=feetech:arm",), tmp_path, http="", log="log"), events.append)

    def says(**datum):
        served._take(json.dumps(datum).encode())

    def log(text, level):
        says(kind="log", t_s=1.0, text=text, level=level)

    says(**SHOT)
    log("board: connected", "info")
    says(kind="joints", t_s=[1.0, 1.1], q_rad=[[0.0] * 5] * 2)
    assert served.state()["healthy"]
    assert (served.values()["board_up"], served.values()["readings_total"]) == (1, 2)
    for _ in range(2):
        log("board: arm: no such port; trying again", "error")
    assert (served.state()["healthy"], served.state()["why"]) == (False, "board: arm: no such port; trying again")
    assert (served.values()["board_up"], served.values()["up"]) == (0, 1)
    served._began -= 3600.0  # shots go on since then
    assert served.state()["for_s"] < 60.0  # the board's own time
    log("board: arm: not homed; trying again", "error")
    assert served.state()["why"] == "board: arm: not homed; trying again"
    log("board: connected", "info")
    log("board: joint 2: hot", "warning")
    log("no board", "error")
    assert served.state()["healthy"]
    assert [each["event"] for each in events] == ["measuring", "board lost", "board lost", "board back"]
    assert served.values()["board_losses_total"] == 1
    said = (tmp_path / "log").read_text()
    assert (said.count("no such port"), said.count("joint 2: hot")) == (1, 1)
    served._hear("board: joint 2: hot")  # the child's own line of what it published
    assert (tmp_path / "log").read_text() == said


def fetch(port, path):
    """Return the code and the text of a page."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_the_pages():
    state = {"healthy": False, "why": "camera gone"}
    page = state_pages("127.0.0.1:0", lambda: state, lambda: {"up": 0.0, "shots_total": 12.0})
    try:
        assert fetch(page.port, "/healthz") == (503, json.dumps(state) + "\n")
        state["healthy"] = True
        assert fetch(page.port, "/healthz")[0] == 200
        assert fetch(page.port, "/metrics")[1].splitlines()[2] == "armsight_up 0"
        assert fetch(page.port, "/else")[0] == 404
        with pytest.raises(InputError, match="does another one run"):
            state_pages(f"127.0.0.1:{page.port}", lambda: state, dict)
    finally:
        page.close()
    with pytest.raises(InputError, match="expected HOST:PORT"):
        state_pages("9110", lambda: state, dict)


def test_metrics_are_in_prometheus_form():
    lines = metrics_text(METRICS, {name: {"": 1.5} for name in METRICS}).decode().splitlines()
    assert len(lines) == 3 * len(METRICS)
    for name, (kind, _) in METRICS.items():
        assert {f"# TYPE armsight_{name} {kind}", f"armsight_{name} 1.5"} <= set(lines)


def write(path, text):
    """Write a file of serve, and return its path."""
    path.write_text(text)
    return path


def test_a_recording_is_measured_once(armsight, rendered, tmp_path):
    file = write(
        tmp_path / "serve.toml",
        f'[measure]\nrig = "{rendered.rig}"\ntarget = "{rendered.plate}"\nsource = "{rendered.folder / "arm"}"\n'
        '[serve]\nhttp = ""\nlog = "serve.log"\n',
    )
    said = armsight("serve", file, "--json").done()
    assert [json.loads(line)["event"] for line in said.out.splitlines()] == ["measuring", "ended"]
    assert "measured 16 of 16 shots" in (tmp_path / "serve.log").read_text()


def test_options_become_arguments(rendered, tmp_path):
    text = f'[measure]\nrig = "{rendered.rig}"\ntarget = "{rendered.plate}"\nsource = "usb:0,1"\n'
    found = read_config(
        write(tmp_path / "a.toml", text + 'stream = ["json+tcp:1", "json+tcp:2"]\n[serve]\nlog_files = 2.0\n')
    )
    assert found.arguments[0] == str(rendered.rig)
    assert {"--source=usb:0,1", "--stream=json+tcp:1", "--stream=json+tcp:2"} <= set(found.arguments)
    assert (found.folder, found.log_files) == (tmp_path, 2)
    text += 'stream = "json+tcp:1"\n[board]\nport = "emulated:host"\n'
    found = read_config(write(tmp_path / "b.toml", text))
    assert "--board=emulated:host" in found.arguments


def test_no_start_writes_over_the_poses_of_another(rendered, tmp_path):
    text = f'[measure]\nrig = "{rendered.rig}"\ntarget = "{rendered.plate}"\nsource = "usb:0,1"\noutput = "poses.csv"\n'
    found, named = read_config(write(tmp_path / "a.toml", text)), []
    for _ in range(3):
        named += [Path(each.removeprefix("--output=")) for each in found.started() if each.startswith("--output=")]
        named[-1].touch()
    assert [each.name for each in named] == ["poses.csv", "poses-2.csv", "poses-3.csv"]
    assert {each.parent for each in named} == {tmp_path}


def test_a_first_start_without_a_shot_ends_it_and_what_is_no_datum_is_passed_over(serving, tmp_path):
    with pytest.raises(InputError, match="no such camera"):
        serving("0 no such camera")
    served = Service(ServeConfig((), tmp_path, http=""), lambda event: None)
    for data in (
        b"x",
        b"[]",
        b"1",
        b'{"kind": "shot"}',
        b'{"kind": "shot", "status": "ok", "age_s": 0, "covariance": null}',
    ):
        served._take(data)
    assert served.values()["shots_total"] == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("source =", "sorce =", "[measure] has an unknown key 'sorce': did you mean source?"),
        ("[measure]", "[mesure]", "unknown table [mesure]; known are [measure], [board] and [serve]"),
        ("[measure]", "[board]\n[measure]", "[board] has no port, such as feetech:/dev/ttyACM0"),
        (
            "[measure]",
            '[board]\nport = "usb:1"\n[measure]\nstream = "json+tcp:1"',
            "no board 'usb:1'; there are emulated:",
        ),
        ("[measure]", '[board]\nport = "serial:/none"\n[measure]\nstream = "json+tcp:1"', "/none: no such port"),
        (
            "[measure]",
            '[board]\nport = "emulated:host"\n[measure]',
            "serve.toml: [board] is published beside live cameras",
        ),
        (
            "[measure]",
            '[measure]\nboard = "serial:/none"',
            "board: not for a service: it is the port of the table [board]",
        ),
        ("[measure]", "[serve]", "expected a table [measure]"),
        ("[measure]", "[run]", "[run] is not served: an arm must not begin to move again"),
        ("[measure]", "[serve]\nlog_files = 0.5\n[measure]", "log_files is 0.5: expected a whole number above 0"),
        ("[measure]", "[measure]\njson = true", "json: not for a service"),
        ("[measure]", "[measure]\nskew = [1, 2]", "skew is [1, 2]: expected one text, number or true"),
        ("target =", "#", "[measure]: Missing option '--target'"),
        ("rig.json", "none.json", "none.json: no such file"),
        ("chessboard:9x6:25mm", "chessbord:9x6:25mm", "chessbord"),
        ("[measure]", "[serve]\nstale_s = 0\n[measure]", "[serve] stale_s is 0: expected a number above 0"),
        ("[measure]", "[serve]\nstale = 3\n[measure]", "[serve] has an unknown key 'stale': did you mean stale_s?"),
        ("[measure]", "[serve]\nhttp = 9110\n[measure]", "[serve] http is 9110: expected a text"),
        ("[measure]", '[serve]\nlog = "no/where.log"\n[measure]', "cannot be written"),
    ],
)
def test_a_wrong_file_is_one_line(armsight, rendered, tmp_path, old, new, words):
    text = f'[measure]\nrig = "{rendered.rig}"\ntarget = "chessboard:9x6:25mm"\nsource = "usb:0,1"\n'
    assert_rejected(armsight("serve", write(tmp_path / "serve.toml", text.replace(old, new))), words)


def test_the_examples_are_what_is_served(rendered, tmp_path):
    here = ROOT / "examples" / "serve"
    text = (
        (here / "serve.toml")
        .read_text()
        .replace("rig.json", str(rendered.rig))
        .replace("body.toml", str(rendered.plate))
    )
    found = read_config(write(tmp_path / "serve.toml", text))
    assert (found.http, found.log) == ("127.0.0.1:9110", "serve.log")
    unit = configparser.ConfigParser()
    unit.read(here / "armsight.service")
    assert unit["Service"]["ExecStart"].split()[1:] == ["serve", "/etc/armsight/serve.toml"]
    assert unit["Service"]["SuccessExitStatus"] == "130"  # an interrupt is no failure
    assert unit["Service"]["KillMode"] == "mixed"  # the child is interrupted once, by the service
    assert float(unit["Service"]["TimeoutStopSec"]) > service._END_S
    container = (here / "Containerfile").read_text()
    assert_has(container, 'ENTRYPOINT ["armsight", "serve", "/cell/serve.toml"]', "STOPSIGNAL SIGTERM")
