"""The page in a headless browser, step by step by clicking, on rendered cameras and the emulated board; and the session."""

import os
import shutil
import urllib.request

import pytest

from armsight.app.live import calibration, records
from armsight.app.live.body import scaled_spec
from armsight.app.live.server import LiveServer
from armsight.app.live.session import LiveSession
from armsight.app.live.step import SessionOptions
from armsight.app.show.page import html_page
from armsight.app.show.table import TextTable, html_table
from armsight.errors import InputError
from armsight.files import read_table
from armsight.sim.workcell import person
from armsight.vision.pose.shot_pose import CSV_COLUMNS
from armsight.vision.rig import StereoRig
from waiting import until

pytestmark = pytest.mark.real_time

pytest.importorskip("websockets")
webdriver = pytest.importorskip("selenium.webdriver")
BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
if not (BROWSER and DRIVER):
    pytest.skip("no browser: apt install chromium chromium-driver", allow_module_level=True)


@pytest.fixture(scope="module")
def browsers():
    """Open browsers with a page each; ``browsers(address)`` returns one."""
    opened = []

    def browser(address):
        options = webdriver.ChromeOptions()
        options.binary_location = BROWSER
        for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
            options.add_argument(argument)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
        opened.append(driver)
        driver.get(address)
        return driver

    yield browser
    for driver in opened:
        driver.quit()


@pytest.fixture(scope="module")
def session(tmp_path_factory, host_firmware):
    quick = pytest.MonkeyPatch()
    quick.setattr(person, "_MOVE_S", 0.15)
    quick.setattr(calibration, "STILL_S", 0.05)
    quick.setattr(calibration, "MODELS", ("brown5",))
    folder = tmp_path_factory.mktemp("live")
    made = LiveSession(SessionOptions(folder, "sim:640x360@15"))
    made.start()
    yield made
    made.close()
    quick.undo()


@pytest.fixture(scope="module")
def server(session):
    made = LiveServer(session, port=0)
    made.start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def page(server, browsers):
    return browsers(server.address)


def click(page, name):
    until(
        lambda: page.execute_script(
            f"const e = document.getElementById('{name}'); return e && !e.disabled && !e.hidden"
        )
    )
    page.execute_script(f"document.getElementById('{name}').click()")


def state(page, path):
    return page.execute_script(f"try {{ return armsight.S.{path} }} catch (e) {{ return null }}")


def test_cameras(page, session):
    until(lambda: page.execute_script("return Math.min(...armsight.frames)") > 1)
    until(lambda: state(page, "cameras.views[0].quality"))
    assert state(page, "cameras.views[0].size_px") == [640, 360]
    until(lambda: page.execute_script("return document.getElementById('view0').width") == 640)
    click(page, "find-left")
    until(lambda: "LEFT" in (state(page, "cameras.finding_left") or ""))
    click(page, "person-cover_right")  # the cable of the left camera was in the other port
    until(lambda: state(page, "cameras.swapped"))
    click(page, "person-uncover")
    click(page, "swap")
    until(lambda: not state(page, "cameras.swapped"))
    click(page, "person-unplug")
    until(lambda: "unplugged" in (state(page, "cameras.problem") or ""))
    click(page, "person-plug")
    until(lambda: state(page, "cameras.problem") is None)


def test_board(page, session):
    click(page, "step-board")
    until(lambda: any("9x6:30mm" in each.text for each in page.find_elements("id", "b-spec")))
    page.execute_script("document.getElementById('b-bar').value = '50'")
    click(page, "use-board")
    until(lambda: any("cannot be right" in each.text for each in page.find_elements("css selector", "#events li")))
    assert state(page, "board.measured_mm") is None
    click(page, "draw-board")
    link = until(lambda: page.find_elements("css selector", "#b-pdf a"))[0].get_attribute("href")
    with urllib.request.urlopen(link, timeout=10) as answer:
        assert answer.read(5) == b"%PDF-"
    assert scaled_spec("chessboard:9x6:30mm", 1.01) == "chessboard:9x6:30.3mm"


def test_calibrate(page, session):
    click(page, "step-calibrate")
    click(page, "k-run")
    shots = until(lambda: len(state(page, "calibrate.shots")) >= 6 and state(page, "calibrate.shots"))
    assert shots[0] == "01"
    until(lambda: {each["kind"] for each in page.execute_script("return drawn")} >= {"next"})
    click(page, "k-finish")
    until(lambda: state(page, "calibrate.rig"))
    rig, truth = StereoRig.load(session.folder / "rig.json"), session.shared.simulated.workcell.truth.rig
    assert rig.baseline_m == pytest.approx(truth.baseline_m, rel=5e-3)
    assert rig.left.intrinsics[0] == pytest.approx(truth.left.intrinsics[0], rel=5e-3)
    progress = state(page, "calibrate.progress")
    assert progress[-1]["heldout_mm"] > 0
    until(lambda: "armsight calibrate" in page.find_element("id", "command").text)
    assert len(list((session.folder / "calibration").glob("left*.png"))) >= 6


def of_true_rig(now):
    """Return the pose that a page shows if it can be one by the true rig: the first may still be by the rig before."""
    pose = now and (now["rig"] or "").endswith("true.json") and now["pose"]
    return pose if pose and pose["points"] == 9 and max(pose["sigma_mm"]) < 0.5 else None


def test_body_and_measure(page, session):
    rigs = (session.folder / "rig.json", session.folder / "true.json")  # the second: this test ran before
    until(lambda: session.measuring.rig_path in rigs)
    truth = session.shared.simulated.workcell.truth
    truth.rig.save(session.folder / "true.json")  # a rig of six shots is good or poor by chance
    session.measuring.use_rig(truth.rig, session.folder / "true.json")
    click(page, "step-body")
    until(lambda: state(page, "body.grade") == "usable")
    click(page, "step-measure")
    until(lambda: session.measuring.newest)  # what the page shows may be older than the rig
    pose = until(lambda: of_true_rig(state(page, "measure")))
    distance_m = float(sum(x**2 for x in pose["position_mm"]) ** 0.5) / 1e3
    assert 0.6 < distance_m < 1.1
    click(page, "m-zero")
    until(lambda: state(page, "measure.relative") and abs(state(page, "measure.pose.position_mm[0]")) < 1.0)
    click(page, "m-mark")
    until(lambda: state(page, "measure.distance_mm"))
    click(page, "m-second")  # the board, as the input proposes
    click(page, "person-board")
    apart = until(lambda: state(page, "measure.second.distance_mm"), why=lambda: session.measuring.state)
    assert 50.0 < apart[0] < 2000.0
    assert apart[1] < 5.0
    click(page, "person-no_board")
    click(page, "m-second")
    until(lambda: state(page, "measure.second") is None)
    until(lambda: state(page, "measure.pose"))
    click(page, "m-record")
    until(lambda: "2 poses" in (state(page, "measure.recording") or ""))
    click(page, "m-record")
    until(lambda: state(page, "measure.recording") is None)
    rows = read_table(session.folder / "poses-1.csv")
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) >= 3


def test_a_full_disk_ends_the_recording_with_a_line(session):
    session.execute(records.RecordPoses())
    measuring, before = session.measuring, len(session.events())
    with measuring.lock:
        measuring._recording._file._file = os.open("/dev/full", os.O_WRONLY)
    until(lambda: any("No space left" in event.text for event in session.events()[before - 1 :]))
    assert measuring.state.recording is None
    until(lambda: measuring.state.pose is not None)


def test_stop_and_two_pages(page, session, server, browsers):
    click(page, "step-arm")
    click(page, "a-open")
    until(lambda: state(page, "arm.q_deg"))
    until(lambda: page.find_element("id", "stopped").text == "or the space key")
    page.find_element("tag name", "body").send_keys(" ")
    answer = until(lambda: page.execute_script("return armsight.stopAnswer"))
    assert answer["stopped"]
    assert answer["state"].startswith("emergency stop")
    until(lambda: state(page, "arm.stopped"))
    until(lambda: page.execute_script("return document.getElementById('a-run').disabled"))
    click(page, "a-clear")
    until(lambda: not state(page, "arm.stopped"))
    other = browsers(server.address)
    until(lambda: state(other, "arm") and other.find_elements("id", "take"))
    other.execute_script("command('GoTo', {step: 'health'})")
    until(
        lambda: any("another page commands" in each.text for each in other.find_elements("css selector", "#events li"))
    )
    assert session.sections()["overview"].step == "arm"
    until(lambda: other.find_element("id", "stopped").text == "or the space key")
    other.execute_script("document.getElementById('stop').click()")
    until(lambda: state(other, "arm.stopped"))
    click(other, "take")
    until(lambda: page.find_elements("id", "take"))
    click(other, "a-clear")
    until(lambda: not state(other, "arm.stopped"))
    page.close()
    assert not [entry for entry in other.get_log("browser") if entry["level"] == "SEVERE"]


def test_the_arm_is_held_when_the_page_that_commands_is_closed(session, server, browsers):
    other = browsers(server.address)
    until(lambda: state(other, "arm"))
    if other.find_elements("id", "take"):
        click(other, "take")
    click(other, "step-arm")
    until(lambda: other.execute_script("return you.commands"))
    click(other, "e-guide")
    until(lambda: "hand-eye: pose" in (state(other, "arm.running") or ""))
    until(lambda: other.find_element("id", "stopped").text == "or the space key")
    other.find_element("tag name", "body").send_keys(" ")  # while it moves
    until(lambda: other.execute_script("return armsight.stopAnswer && armsight.stopAnswer.stopped"))
    until(lambda: any("has ended early: " in event.text for event in session.events()))
    click(other, "a-clear")
    until(lambda: not state(other, "arm.stopped"))
    if until(lambda: not session.arm.busy) and session.arm.state.away:  # it was moving when its motors were released
        click(other, "a-start")
        until(lambda: not session.arm.state.away and not session.arm.busy)
    click(other, "a-run-open")
    until(lambda: "hand-eye: pose" in (state(other, "arm.running") or ""))
    with pytest.raises(InputError, match="the arm moves"):
        session.execute(records.Swap())
    other.get("about:blank")
    until(lambda: any("the arm is held: the page" in event.text for event in session.events()))
    until(lambda: not session.arm.busy)
    until(lambda: session.arm.state.state.startswith("held at rest"))
    assert "the page" in session.sections()["overview"].held
    assert "--board emulated:unicorn --rig" in session.arm.state.command  # as it can be typed
    until(lambda: (session.folder / "run" / "summary.json").exists())
    assert (session.folder / "run" / "run.mcap").stat().st_size > 10000


def test_no_table_of_a_report_is_cut_on_a_phone(browsers, tmp_path):
    columns = ("cause", "mm", "95 %, from to", "left by the remedy, mm", "remedy")
    cells = ("a cause of many words", "1480.45 \u00b1 3.56", "0.510 to 17.729", "not determined", "a remedy in words")
    html = html_table(TextTable("a table", columns, (cells,) * 3))
    (tmp_path / "report.html").write_text(html_page("a page", "a page", "", {"a": ("a", html)}), encoding="utf-8")
    page = browsers("about:blank")
    for width, named in ((390, f'"{columns[1]}"'), (1280, "none")):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": True}
        page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        page.get(f"file://{tmp_path}/report.html")
        cells = "return [...document.querySelectorAll('table, td, th')]"
        wide = cells + ".filter(e => e.scrollWidth > e.clientWidth + 1).length"
        shown = "return getComputedStyle(document.querySelector('td'), '::before').content"
        assert page.execute_script(wide) == 0
        assert page.execute_script("return document.documentElement.scrollWidth") <= width
        assert page.execute_script(shown) == named
