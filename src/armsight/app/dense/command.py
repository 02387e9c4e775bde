"""``armsight dense``: a disparity, and with a rig a depth, for every pixel; and the evaluation of the methods."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.options import JSON, argument, declared, option, out
from armsight.app.progress import bar
from armsight.app.show.messages import note, print_answer
from armsight.errors import ArmsightError, InputError
from armsight.files import check_folder
from armsight.vision.dense import METHODS, open_method

if TYPE_CHECKING:
    from armsight.app.dense.evaluate import SceneResult
    from armsight.app.dense.run import PairResult
    from armsight.data import Shot
    from armsight.vision.rectify import Rectification


class _Dense(click.Group):
    """A group whose command without a name is ``match``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put ``match`` before arguments that begin with no command."""
        if args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = ["match", *args]
        return super().parse_args(ctx, args)


@click.group("dense", cls=_Dense)
def command() -> None:
    """Find a disparity for every pixel of a pair, or evaluate the methods on scenes with a truth.

    \b
    armsight dense RIG.json LEFT RIGHT -o OUT        depth, point cloud
    armsight dense RIG.json --source SOURCE -o OUT   every shot of a sequence
    armsight dense LEFT RIGHT --max-disparity N -o OUT   a rectified pair
    armsight dense evaluate DIR                      the Middlebury benchmark's metrics

    More: armsight dense match -h, armsight dense evaluate -h.
    """  # noqa: D301 - click keeps the lines of a paragraph that begins so


@command.command("match")
@declared
def match(
    paths: tuple[Path, ...] = argument("[RIG.json] [LEFT RIGHT]"),
    name: str = option("Matching method.", "--method", default="semiglobal", choices=METHODS),
    output: Path = out("DIR", "Folder for the files."),
    source: str | None = option("A sequence instead of LEFT RIGHT (see armsight record -h).", metavar="SOURCE"),
    max_disparity: int | None = option("Disparities below N px are tried.", metavar="N"),
    near: float | None = option("Nearest depth, m, instead of N; 3 baselines by default.", metavar="M"),
    as_json: bool = option("Print one JSON object a pair.", "--json"),
) -> None:
    """Match a pair, or every shot of a source, and write disparity, picture, and with a rig depth and point cloud.

    In OUT: disparity.pfm (px, left image, filled), valid.png (255 where it was measured), disparity.png (16 bits, 64
    steps a px), state.png (1 measured, 2 hidden from the right camera, 3 filled), sigma.pfm (px), picture.png; with a
    rig left.png and right.png, rectified, depth_mm.pfm, depth_sigma_mm.pfm and cloud.ply (m, left camera's
    frame).
    """
    from armsight.app.dense.files import RESULT_FILES
    from armsight.app.dense.run import check_near, problem_line, read_pair, result_line, run_shot, search_of
    from armsight.vision.sources import open_source

    form, pair = _arguments(paths, source, max_disparity, near)
    check_folder(output, holding=RESULT_FILES, signs=("sigma.pfm",), apart_from=paths)
    if form is not None and near is not None:
        check_near(form, near)
    method = open_method(name)

    def run(shot: Shot, where: Path) -> PairResult:
        search = search_of(form, max_disparity, near, shot)
        result = run_shot(shot, where, form, method, search, note)
        print_answer(as_json, result.to_json(), result_line(result))
        return result

    if pair is not None:
        run(read_pair(*pair), output)
    else:
        done, total = 0, 0
        with contextlib.closing(open_source(str(source))) as opened, bar("matching", None) as advance:
            while (shot := opened.read()) is not None:
                total += 1
                if shot.problem is not None:
                    problem = {"shot": shot.name, "problem": shot.problem}
                    print_answer(as_json, problem, problem_line(shot.name, shot.problem))
                else:
                    done += run(shot, output / shot.name).summary.problem is None
                advance()
        if not done:
            raise ArmsightError(f"{source}: none of {total} shots could be matched; their lines say why")
    if form is None:
        note("no RIG.json: the images were taken as rectified")


def _arguments(
    paths: tuple[Path, ...], source: str | None, max_disparity: int | None, near: float | None
) -> tuple[Rectification | None, tuple[Path, Path] | None]:
    """Return how to rectify (None: rectified already), and the pair (None: a source was given)."""
    from armsight.vision.rig import StereoRig

    images = 0 if source is not None else 2
    if len(paths) not in (images, images + 1):
        form = "RIG.json and --source" if source is not None else "RIG.json LEFT RIGHT"
        raise InputError(f"expected {form}, got {len(paths)} path{'' if len(paths) == 1 else 's'}")
    rectified = len(paths) == images
    if rectified and near is not None:
        raise InputError("--near needs a RIG.json: a rectified pair alone has no depth; give --max-disparity")
    if rectified and max_disparity is None:
        raise InputError(
            "no RIG.json before the images: a rectified pair needs --max-disparity N, as nothing else says how near the "
            "scene is"
        )
    if max_disparity is not None and near is not None:
        raise InputError("give --max-disparity or --near, not both")
    if near is not None and not 0.01 <= near <= 1000:
        raise InputError(f"--near {near:g}: expected metres, between 0.01 and 1000")
    rig = None if rectified else StereoRig.load_trusted(paths[0])
    if rig is not None and not rig.cov.any():
        note(f"{paths[0]} does not say how well it is known: sigma is the matching's share alone")
    pair = None if source is not None else (paths[-2], paths[-1])
    return None if rig is None else rig.rectify(), pair


@command.command("evaluate")
@declared
def evaluate(
    folder: Path = argument("DIR"),
    names: tuple[str, ...] = option("May be repeated; all by default.", "--method", choices=METHODS),
    output: Path | None = out("OUT", "Write the table and error maps there."),
    as_json: bool = JSON,
) -> None:
    """Evaluate the methods on scenes with a truth, in the folder layouts of the Middlebury benchmark.

    DIR is a scene or a folder of scenes. Metrics: share of pixels off by more than 0.5, 1, 2 and 4 px, mean, RMS, and
    the errors that 50, 90, 95 and 99% stay below, over all pixels and over those both cameras see. Gaps are filled.
    With OUT: table.csv, and for each scene and method an error map and the disparities in colour.
    """
    from armsight.app.dense.evaluate import evaluate_scene, evaluation_json, table_text, write_evaluation
    from armsight.vision.dense.middlebury import find_scenes, load_scene

    if output is not None:
        check_folder(output)
    scenes, chosen = find_scenes(folder), names or tuple(METHODS)
    for path in scenes:
        load_scene(path)  # all can be read, before anything is written
    lines: list[SceneResult] = []
    with bar("evaluating", len(scenes) * len(chosen)) as advance:
        for path in scenes:
            scene = load_scene(path)
            for name in chosen:
                lines.append(evaluate_scene(scene, name, output))
                advance()
    if output is not None:
        write_evaluation(output, lines)
    print_answer(as_json, evaluation_json(lines), table_text(lines))
