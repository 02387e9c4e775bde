"""Open what is to be replayed, and replay it: the request of the command line in, a :class:`~.run.Replayed` out."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from armsight.app.replay.recorded import RecordedRun, read_run, run_file
from armsight.app.replay.run import Pace, Replayed, replay_run, replay_source, replay_tags
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import ARM, BODY, REFERENCES, arm_of
from armsight.app.stream.streams import open_streams
from armsight.data import Body
from armsight.errors import InputError
from armsight.loop.references.file import entries_of, read_references
from armsight.loop.running.beside import fused, recorded, the_one
from armsight.robot.arm_file import open_arm
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_body, open_target
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source, notes_of, open_source
from armsight.vision.sources.bag import Bag
from armsight.vision.sources.bag.camera_info import bag_rig
from armsight.vision.sources.bag.images import IMAGES, image_topics, parsed, source_of
from armsight.vision.sources.bag.reader import SUFFIXES
from armsight.vision.sources.bag.states import read_joints
from armsight.vision.sources.bag.tags import TAGS, read_tags
from armsight.vision.sources.folder import INDEX

_PROPERTIES = {"command": "replay"}


@dataclass(frozen=True)
class Request:
    """What is to be replayed, as the command line names it; None is what was recorded."""

    recording: str  #: RUN or BAG
    rig: str | None = None  #: rig file
    target: str | None = None  #: spec of a board, or body file
    arm: str | None = None  #: arm model
    estimator: str = "kalman"  #: a name of ESTIMATORS
    rate: float = 0.0  #: seconds of the recording a second; 0 as fast as possible
    references: Path | None = None  #: file of references that are fused with a run
    streams: tuple[str, ...] = ()  #: what to publish to


def replay(request: Request, say: Callable[[str], None]) -> Replayed:
    """Replay a recording; ``say`` is given notes, a line each."""
    name = str(request.recording)
    if ":" not in name and not Path(name.split(",")[0]).exists():
        raise InputError(f"{name}: no such file or folder; expected a run's folder, its run.mcap or a bag")
    file = run_file(request.recording)
    recorded = None if file is None else read_run(file)
    if recorded is not None and recorded.has_estimator:
        return _of_run(request, recorded, say)
    return _of_source(request, recorded, say)


def _of_run(request: Request, run: RecordedRun, say: Callable[[str], None]) -> Replayed:
    for note in run.notes:
        say(f"note: {note}")
    if request.rig is not None or request.target is not None:
        raise InputError(
            f"{request.recording}: another --rig or --target needs the images of every shot, which a run does not keep; "
            "its estimators can be replayed, with another --arm or --estimator"
        )
    if ARM not in run.properties or BODY not in run.properties:
        raise InputError(f"{run.path}: its metadata name no arm or no body: it was written by another version")
    arm = arm_of(run.properties[ARM]) if request.arm is None else open_arm(request.arm)
    body = _body_of(run)
    rig = StereoRig.from_text(run.properties["rig.json"], f"{run.path}: rig.json")
    changed = request.arm is not None or request.estimator != "kalman"
    if request.references is not None and changed:
        raise InputError("--references goes with the run's own arm and estimator; leave out --arm and --estimator")
    beside, text = None, run.properties.get(REFERENCES)
    if request.references is not None:
        beside = recorded(the_one(read_references(request.references)))
    elif text is not None and request.estimator == "kalman":
        beside = fused(the_one(entries_of(text, run.path)))
    with contextlib.closing(open_streams(request.streams, Published(rig, body, arm, _PROPERTIES), say)) as publisher:
        return replay_run(
            run,
            arm,
            body,
            estimator=request.estimator,
            pace=Pace(request.rate),
            publisher=publisher,
            changed=changed,
            beside=beside,
            own=request.references is None,
        )


def _body_of(recorded: RecordedRun) -> Body:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / BODY
        path.write_text(recorded.properties[BODY], encoding="utf-8")
        return open_target(str(path)).body


def _of_source(request: Request, recorded: RecordedRun | None, say: Callable[[str], None]) -> Replayed:
    path, named = parsed(request.recording.removeprefix("bag:"))
    folder = Path(path).expanduser()
    of_images = folder.is_dir() and (
        (folder / INDEX).is_file() or not any(each.suffix in SUFFIXES for each in folder.iterdir())
    )
    bag = None if of_images else Bag(path if recorded is None else recorded.path)
    if request.references is not None:
        raise InputError(f"{request.recording}: --references needs a run with its joints; this holds none")
    if request.target is None:
        if bag is None:
            open_source(path)  # what holds no images needs no target
        raise InputError(f"{request.recording}: what is to be measured in it? give --target, a board or a body file")
    if bag is None:
        return _of_images(request, open_source(path), None, say)
    if bag.of_kind(*IMAGES):
        return _of_images(request, source_of(bag, image_topics(bag, named)), bag, say)
    if not bag.of_kind(*TAGS):
        raise InputError(f"{request.recording}: holds neither images nor tags of two cameras; it holds {bag.holds()}")
    rig = _rig(request, bag, named)
    csv = request.target.lower().endswith(".csv")
    target: Target | Body = open_body(request.target) if csv else open_target(request.target)
    body = target if isinstance(target, Body) else target.body
    spec = request.recording if request.recording.startswith("bag:") else f"bag:{request.recording}"
    shots, notes = read_tags(spec, target)
    for note in notes:
        say(f"note: {note}")
    with contextlib.closing(
        open_streams(request.streams, Published(rig, body, properties=_PROPERTIES), say)
    ) as publisher:
        replayed = replay_tags(rig, body, shots, pace=Pace(request.rate), publisher=publisher)
    return _with_joints(replayed, bag, say)


def _of_images(request: Request, source: Source, bag: Bag | None, say: Callable[[str], None]) -> Replayed:
    assert request.target is not None
    said = notes_of(source)
    for note in said:
        say(f"note: {note}")
    target, rig = open_target(request.target), _rig(request, bag, {})
    published = Published(rig, target.body, properties=_PROPERTIES)
    with contextlib.closing(open_streams(request.streams, published, say)) as publisher:
        replayed = replay_source(rig, target, source, pace=Pace(request.rate), publisher=publisher)
    for note in notes_of(source)[len(said) :]:
        say(f"note: {note}")
    return replayed if bag is None else _with_joints(replayed, bag, say)


def _rig(request: Request, bag: Bag | None, named: dict[str, str]) -> StereoRig:
    if request.rig is not None:
        return StereoRig.load_trusted(request.rig)
    if bag is None:
        raise InputError(f"{request.recording}: holds no rig: give --rig")
    return bag_rig(bag, named)


def _with_joints(replayed: Replayed, bag: Bag, say: Callable[[str], None]) -> Replayed:
    joints = read_joints(bag)
    if joints is None:
        return replayed
    for note in joints.notes:
        say(f"note: {note}")
    return replace(replayed, joints=joints)
