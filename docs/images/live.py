"""Take the picture of the live page that docs/howto/live.md shows: the guided calibration, in a headless browser.

``python docs/images/live.py [FOLDER]`` writes live.png beside this file, or live_STEP_LOOK.png of every step in light, dark
and at a phone's width into a folder, to be looked at.
"""

import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from selenium import webdriver

from armsight.app.live import records
from armsight.app.live.server import LiveServer
from armsight.app.live.session import LiveSession, SessionOptions
from armsight.sim.workcell.workcell import CHESSBOARD

LOOKS = {"light": (1400, 1020, "light", 1.0), "dark": (1400, 1020, "dark", 1.0), "phone": (390, 844, "light", 2.0)}


def browser(address: str) -> webdriver.Chrome:
    """Open the page."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"):
        options.add_argument(argument)
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    driver.get(address)
    return driver


def look(driver: webdriver.Chrome, name: str, path: Path) -> None:
    """Take a picture in one of LOOKS."""
    width, height, scheme, factor = LOOKS[name]
    metrics = {"width": width, "height": height, "deviceScaleFactor": factor, "mobile": width < 500}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    feature = {"name": "prefers-color-scheme", "value": scheme}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    time.sleep(1.5)
    driver.save_screenshot(str(path))


def until(true: Callable[[], object]) -> None:
    """Wait."""
    end = time.monotonic() + 300
    while not true() and time.monotonic() < end:
        time.sleep(0.1)


def main(folder: Path | None) -> None:
    """Go through the steps."""
    session = LiveSession(SessionOptions(Path(tempfile.mkdtemp()) / "live", "sim:960x540@15"))
    session.start()
    server = LiveServer(session, port=0)
    server.start()
    driver = browser(server.address)

    def take(step: str) -> None:
        for name in LOOKS if folder else ():
            look(driver, name, folder / f"live_{step}_{name}.png")

    until(lambda: session.sections()["cameras"].views[0].quality)
    take("cameras")
    session.execute(records.GoTo("board"))
    take("board")
    session.execute(records.Calibrate())
    until(lambda: len(session.calibration.state.progress) >= 3 and session.calibration.state.still > 0)
    if folder is None:
        look(driver, "light", Path(__file__).with_suffix(".png"))
    else:
        take("calibrate")
        until(lambda: session.calibration.state.good)
        session.execute(records.FinishCalibration())
        until(lambda: session.measuring.rig)
        take("calibrated")
        session.execute(records.GoTo("body"))
        until(lambda: session.body.state.grade)
        take("body")
        session.execute(records.GoTo("measure"))
        session.execute(records.UseSecondBody(CHESSBOARD))
        session.execute(records.PersonAction("board"))
        until(lambda: (second := session.measuring.state.second) and second.reason is None)
        take("measure")
        session.execute(records.PersonAction("no_board"))
        session.execute(records.UseSecondBody(""))
        session.execute(records.GoTo("arm"))
        take("arm_before")
        session.execute(records.OpenArm())
        until(lambda: session.arm.state.q_deg)
        session.execute(records.GuideHandEye())
        until(lambda: session.arm.state.handeye.poses > 8)
        take("handeye")
        until(lambda: not session.sections()["overview"].moving)
        session.execute(records.Identify())
        until(lambda: session.arm.state.identify.headline)
        take("identified")
        session.execute(records.RunMotions())
        until(lambda: len(session.arm.state.error_mm) > 300)
        take("arm")
        session.stop()
        take("stopped")
        session.execute(records.GoTo("health"))
        take("health")
    driver.quit()
    server.close()
    session.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
