"""The steps of every arm's page: what a person does, then the command, as the page has it."""

from __future__ import annotations

from dataclasses import dataclass

#: What the pages call the cameras and the port; setup writes this computer's instead.
CAMERAS, PORT = "usb:0,1", "/dev/ttyACM0"


@dataclass(frozen=True)
class SetupStep:
    """A step of a page."""

    say: str
    command: str
    given: str = ""  #: a file of the user's own that it takes; where there is none, see ``without``
    #: what the words of ``given`` and all that hangs on it become: old text -> new text in all commands; empty where
    #: the step is left out
    without: tuple[tuple[str, str], ...] = ()
    endless: bool = False  #: Ctrl-C ends it as it should end, and it is done
    needed: bool = True  #: whether what follows needs it
    simulated: str = ""  #: options that let it go through where nobody is at the terminal


PLATE, BOARD = "examples/arm_plate.toml", "chessboard:9x6:20mm"
_CHARUCO = "charuco:7x6:20mm:15mm:DICT_4X4_50"
_SHOW = "Hold the board before both cameras and move it for a minute: near, far, into all corners, tilted."
_POSES = (
    "Let the arm's own program go to thirty poses in view, and log its joint angles (docs/arms/%s.md); then Ctrl-C."
)


def _by_loop(arm: str, board: str, look: SetupStep, written: SetupStep) -> tuple[SetupStep, ...]:
    """Return the steps of an arm that armsight moves."""
    return (
        SetupStep(
            "The first page is the board, glued to glass or aluminium, the second the plate on the arm.",
            f"body draw {BOARD} {PLATE} -o print.pdf",
        ),
        SetupStep(_SHOW, f"calibrate --source {CAMERAS} --target {BOARD} -o rig.json"),
        look,
        SetupStep(
            "The arm moves on its own: clear the table, keep a hand on the switch.",
            f"run --source {CAMERAS} --board {board} --rig rig.json --target {PLATE} --arm {arm} -o run",
        ),
        SetupStep("Accuracy and repeatability with the loop closed.", "check run --closed", needed=False),
        SetupStep("What the arm really is.", f"identify --arm {arm} --data run/handeye_poses.csv -o corrected"),
        written,
    )


def _by_maker(arm: str, page: str, table: SetupStep | None, corrected: SetupStep | None) -> tuple[SetupStep, ...]:
    """Return the steps of an arm that its own controller moves."""
    used = arm if table is None else f"my_{arm}.urdf"
    steps = (
        SetupStep(
            "The board, glued to a sheet: before the cameras, then on the flange.",
            f"body draw {_CHARUCO} -o board.pdf",
        ),
        SetupStep(_SHOW, f"calibrate --source {CAMERAS} --target {_CHARUCO} -o rig.json"),
        table,
        SetupStep(_POSES % page, f"record {CAMERAS} -o poses --seconds 300", endless=True),
        SetupStep("Where the board was.", "measure rig.json --target rig.board.toml --source poses -o poses.csv"),
        SetupStep(
            "What the arm really is.", f"identify --arm {used} --data poses.csv --joints joints.csv -o corrected"
        ),
        corrected,
    )
    return tuple(step for step in steps if step is not None)


def _calibrated(arm: str, file: str) -> SetupStep:
    """Return the step that takes the maker's own calibration of an arm."""
    without = ((f"my_{arm}.urdf", arm),)
    return SetupStep(
        "The maker's calibration.", f"arm calibrated {arm} {file} -o my_{arm}.urdf", given=file, without=without
    )


_LEROBOT = "my_arm.json"
_SO101 = _by_loop(
    "so101",
    f"feetech:{PORT},{_LEROBOT}",
    SetupStep(
        "Bring the arm by hand near 0 in all joints, then press Ctrl-C.",
        f"board monitor --board feetech:{PORT},{_LEROBOT}",
        given=_LEROBOT,
        without=((f",{_LEROBOT}", ""),),
        endless=True,
        simulated="--seconds 1",
    ),
    SetupStep(
        "The zeros of the servos. It asks before it switches the drives off, and before it writes.",
        f"board offsets --board feetech:{PORT},{_LEROBOT} --identified corrected/corrected.toml --arm so101",
        simulated="--yes",
    ),
)
_YAML = "annin_ar4_driver/config/joint_offsets/mk3.yaml"
_AR4 = _by_loop(
    "ar4",
    f"ar4:{PORT}",
    SetupStep("All joints move to their ends.", f"board home --board ar4:{PORT} --at-once 1", simulated="--yes"),
    SetupStep(
        "The zeros in the driver's own file; then home again.",
        f"board offsets --board ar4:{_YAML} --identified corrected/corrected.toml --arm ar4 --keep old.yaml",
        given=_YAML,
    ),
)
_OWN = _by_loop(
    "six_r",
    f"serial:{PORT}",
    SetupStep("Each joint by hand, then its motor by itself.", f"board bringup --board serial:{PORT} -o bringup"),
    SetupStep(
        "The zeros of the potentiometers; then run and check once more.",
        f"board offsets --board serial:{PORT} --identified corrected/corrected.toml --arm six_r",
        simulated="--yes",
    ),
)


def _ur(arm: str) -> tuple[SetupStep, ...]:
    corrected = f"arm calibrated {arm} corrected/corrected.toml -o {arm}_corrected.yaml"
    table = _calibrated(arm, f"my_{arm}_calibration.yaml")
    return _by_maker(arm, "ur", table, SetupStep("The corrected table for the driver.", corrected))


def _xarm(arm: str) -> tuple[SetupStep, ...]:
    corrected = f"arm calibrated {arm} corrected/corrected.toml -o {arm}_kinematics_corrected.yaml"
    table = _calibrated(arm, f"{arm}_kinematics_mine.yaml")
    return _by_maker(arm, "xarm", table, SetupStep("The corrected table for the driver.", corrected))


#: Arm -> its steps.
ARMS: dict[str, tuple[SetupStep, ...]] = {
    "so101": _SO101,
    "ar4": _AR4,
    "six_r": _OWN,
    **{arm: _ur(arm) for arm in ("ur3", "ur5", "ur10", "ur3e", "ur5e", "ur10e")},
    **{arm: _xarm(arm) for arm in ("xarm6", "xarm7")},
    "franka": _by_maker("franka", "franka", None, None),
}
