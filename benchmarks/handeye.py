"""Hand-eye calibration: beside the baselines of KinHEC on sequences whose truth is known, and on real recordings.

    pip install -e ".[bench]"
    python benchmarks/handeye.py --tier small --seed 16180 -o kinhec.json
    ARMSIGHT_DATA=.. python benchmarks/handeye.py --real      kuka2, open3dv, ur3a by the command alone, poses left out

KinHEC (MIT) makes pose streams of arms and cameras: noise, degenerate motions, clock offsets, blunders, unknown scale,
wrong kinematics, PnP. Its baselines get what its own protocol gives them (keyframes; the clock offset by correlation);
armsight gets the two streams. A sequence counts in the comparison where armsight answers; what it rejects is counted
apart, with what the baselines answer there.

Per track: median error of X, mm and degrees, ours and of each baseline; how often the ellipsoid of 95 % of X holds the
truth; the median NEES (5.35 with six degrees of freedom is honest); rejections; the error of the clock offset.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from armsight.errors import ArmsightError
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.handeye.handeye import calibrate_poses
from armsight.loop.handeye.poses import Poses
from armsight.loop.handeye.streams import PoseStream, calibrate_streams

#: A motion is degenerate where the second eigenvalue of KinHEC's scatter of rotation axes is below this: parallel axes.
DEGENERATE = 1e-6


@dataclass
class Row:
    """One sequence.

    Attributes:
        translation_mm, rotation_deg: errors of X; NaN where rejected.
        nees: squared Mahalanobis length of the error of X.
        offset_ms: error of the clock offset; NaN where there is none.
        peers: baseline -> its errors of X, mm and deg.
    """

    name: str
    track: str
    level: str
    degenerate: bool
    translation_mm: float = float("nan")
    rotation_deg: float = float("nan")
    nees: float = float("nan")
    offset_ms: float = float("nan")
    peer_offset_ms: float = float("nan")
    structure: str = ""
    rejected: str = ""
    seconds: float = 0.0
    peers: dict[str, tuple[float, float]] = field(default_factory=dict)


def _links_at(sequence):
    """Times -> T_link_flange by the joints read and the arm's nominal model; None for a body that no arm moves."""
    from kinhec.kinematics import forward_kinematics_all
    from kinhec.robots import get_robot

    t, q = sequence.robot.t, sequence.robot.q_meas
    if q is None:
        return None
    robot = get_robot(sequence.manifest["robot"])

    def flange(joints):
        return np.array([forward_kinematics_all(robot, one)[-1] for one in joints])

    q = np.array(q)
    for _ in range(2):  # KinHEC's poses have noise that its joints have not: joints that give these very poses
        T = flange(q)
        off = log_se3(inverse(T) @ sequence.robot.T_base_ee_meas)
        by = [log_se3(inverse(T) @ flange(q + 1e-6 * one)) / 1e-6 for one in np.eye(q.shape[1])]
        q += np.einsum("nji,ni->nj", np.linalg.pinv(np.stack(by, axis=2), rcond=1e-2), off)

    def links(at):
        joints = np.stack([np.interp(at, t, column) for column in q.T], axis=1)
        frames = np.array([forward_kinematics_all(robot, one) for one in joints])
        return inverse(frames) @ frames[:, -1:]

    return links


def ours(sequence, row: Row, joints: bool) -> None:
    """Calibrate a sequence by armsight alone; with ``joints`` the joint angles and the arm's model are known too."""
    seen = sequence.camera.has_measurement
    B, t = sequence.camera.T_cam_target_meas[seen], sequence.camera.t[seen]
    eye = "in_hand" if sequence.eye_in_hand else "to_hand"
    ordered = sequence.manifest["sampling_mode"] == "continuous"
    started = time.perf_counter()
    links_at = _links_at(sequence) if joints else None
    try:
        if sequence.synchronous:
            A = sequence.robot.T_base_ee_meas[seen]
            poses = Poses(A, B, np.zeros((len(A), 6, 6)), eye == "in_hand", np.zeros(3))
            links = None if links_at is None else links_at(t)
            found = calibrate_poses(poses, t_s=t if ordered else None, links=links, scale=True)
        else:
            hand = PoseStream.of(sequence.robot.t, sequence.robot.T_base_ee_meas, "hand")
            eyes = PoseStream.of(t, B, "eye")
            streams = calibrate_streams(hand, eyes, eye=eye, scale=True, links_at=links_at)
            found = streams.handeye
            row.offset_ms = 1e3 * abs(-streams.offset_s - sequence.time_offset)
    except ArmsightError as error:
        row.rejected = str(error)
    else:
        e = log_se3(inverse(found.T_flange_held) @ sequence.X)
        row.translation_mm = 1e3 * float(np.linalg.norm(found.T_flange_held[:3, 3] - sequence.X[:3, 3]))
        row.rotation_deg = float(np.degrees(np.linalg.norm(e[3:])))
        row.nees = float(e @ np.linalg.solve(found.cov[6:, 6:], e))
        row.structure = found.structure
    row.seconds = time.perf_counter() - started


def evaluate(folder: Path, tracks: list[str] | None, limit: int | None, joints: bool) -> list[Row]:
    """Evaluate the sequences of a folder."""
    from kinhec import load_manifest, load_sequence
    from kinhec.benchmark import SOLVERS, evaluate_sequence

    manifest = load_manifest(folder, tracks)
    if limit is not None:  # spread over the levels of each track
        manifest = manifest[
            manifest.groupby("track").cumcount() % np.ceil(manifest.groupby("track")["track"].transform("size") / limit)
            == 0
        ]
    rows = []
    for k, name in enumerate(manifest["sequence_id"]):
        sequence = load_sequence(folder, name, manifest)
        m = sequence.manifest
        row = Row(name, m["track"], m["level"], bool(m["axis_scatter_lambda2"] < DEGENERATE))
        ours(sequence, row, joints)
        sync = "oracle" if sequence.synchronous else "estimated"
        for found in evaluate_sequence(sequence, list(SOLVERS), sync, np.random.default_rng(k)):
            if found["ok"]:
                row.peers[found["solver"]] = (found["X_trans_err_mm"], found["X_rot_err_deg"])
            row.peer_offset_ms = found["time_offset_err_ms"]
        rows.append(row)
        print(
            f"{name} {m['level'][:60]:60s} {row.translation_mm:9.3f} mm {row.rotation_deg:7.3f} deg NEES {row.nees:8.2f} "
            f"{row.seconds:5.1f} s {row.structure} {row.rejected[:60]}",
            flush=True,
        )
    return rows


def _median(values) -> float:
    found = [v for v in values if np.isfinite(v)]
    return float(np.median(found)) if found else float("nan")


def summary(rows: list[Row]) -> list[str]:
    """Return the tables."""
    lines = [
        "| track | sequences | rejected | mm | deg | best by mm | its mm | best by deg | its deg | in 95 % | NEES | s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    tracks = list(dict.fromkeys(row.track for row in rows))
    for track in tracks:
        of = [row for row in rows if row.track == track]
        done = [row for row in of if not row.rejected]
        names = sorted({name for row in done for name in row.peers}) or ["none"]
        peers = {n: [_median(r.peers.get(n, (np.inf, np.inf))[k] for r in done) for k in (0, 1)] for n in names}
        by_mm, by_deg = (min(peers, key=lambda n, k=k: peers[n][k]) for k in (0, 1))
        holds = np.mean([row.nees < chi2.ppf(0.95, 6) for row in done])
        lines.append(
            f"| {track} | {len(of)} | {len(of) - len(done)} | {_median(r.translation_mm for r in done):.2f} | "
            f"{_median(r.rotation_deg for r in done):.3f} | {by_mm} | {peers[by_mm][0]:.2f} | {by_deg} | "
            f"{peers[by_deg][1]:.3f} | {100 * holds:.0f} % | {_median(r.nees for r in done):.1f} | "
            f"{_median(r.seconds for r in of):.1f} |"
        )
    degenerate = [row for row in rows if row.degenerate]
    rejected = [row for row in rows if row.rejected]
    offsets = [row for row in rows if np.isfinite(row.offset_ms)]
    peers_there = _median(min((e[0] for e in row.peers.values()), default=np.nan) for row in rejected)
    lines += [
        "",
        f"degenerate motions: {len(degenerate)}, of which rejected {sum(bool(r.rejected) for r in degenerate)}; rejected "
        f"though not degenerate: {sum(not r.degenerate for r in rejected)}; median of the best baseline where rejected: "
        f"{peers_there:.1f} mm",
        f"clock offset, {len(offsets)} sequences: median {_median(r.offset_ms for r in offsets):.3f} ms; KinHEC's "
        f"correlation {_median(r.peer_offset_ms for r in offsets):.3f} ms",
    ]
    return lines


def generated(tier: str, seed: int, folder: Path) -> None:
    """Make a tier's sequences with a seed of our own; what is there already is kept."""
    import kinhec
    import yaml
    from kinhec.cli import main

    spec = yaml.safe_load((Path(kinhec.__file__).parent / "configs" / f"{tier}.yaml").read_text())
    spec["global_seed"] = seed
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tier.yaml").write_text(yaml.safe_dump(spec))
    main(
        ["generate", "--tier", str(folder / "tier.yaml"), "--out", str(folder), "--no-card", "--work-dir", str(folder)]
    )


def command(*words) -> dict:
    """Run an armsight command with --json and return its answer; its words where it ends with an error."""
    done = subprocess.run(
        [sys.executable, "-c", "from armsight.app.main import main; main()", *map(str, words), "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"armsight {words[0]} ended with {done.returncode}: {done.stderr.strip()}")
    return json.loads(done.stdout)


def kuka2(data: Path, _: Path) -> list[str]:
    """Return the arguments for a camera in a KUKA's hand, calibrated from the same images."""
    folder = data / "handeye" / "kuka2"
    eye = ["--robot", folder / "RobotPosesVec.txt", "--eye", "in-hand"]
    return [*eye, "--source", folder / "im_*.png", "--camera", "fit", "--target", "chessboard:24x17:15mm"]


def open3dv(data: Path, work: Path) -> list[str]:
    """Return the arguments for a camera with its own calibration in a hand, before a board of bright discs."""
    folder = data / "real" / "open3dv-discs"
    given = np.loadtxt(folder / "param.txt")
    camera = {"image_size_px": [1920, 1200], "K": given[:9].reshape(3, 3).tolist(), "distortion": given[9:14].tolist()}
    (work / "camera.json").write_text(json.dumps(camera))
    rows = [(f"pos{k}.png", *np.loadtxt(folder / f"pos{k}.txt")) for k in range(8)]
    names = "image,rx_deg,ry_deg,rz_deg,x_mm,y_mm,z_mm"
    (work / "robot.csv").write_text("\n".join([names, *(",".join(map(str, row)) for row in rows)]))
    robot = [
        "--robot",
        work / "robot.csv",
        "--columns",
        "rotation=xyz",
        "--eye",
        "in-hand",
        "--camera",
        work / "camera.json",
    ]
    return [*robot, "--source", folder / "pos*.png", "--target", "acircles:7x11:10mm"]


def ur3a(data: Path, work: Path) -> list[str]:
    """Calibrate two webcams by the recording's own images; return the arguments for a board on a UR3e's flange.

    Its camera 2 stands to the left.
    """
    folder = data / "real" / "ur3a"
    pairs = ["--source", f"pairs:{folder}/cam2_*.png,{folder}/cam1_*.png", "--target", "chessboard:9x7:20mm"]
    alone = ["--alone", f"{folder}/intrinsics_cam2/*.jpg,{folder}/intrinsics_cam1/*.jpg"]
    command("calibrate", *pairs, *alone, "-o", work / "rig.json")
    names, *rows = (folder / "joints.csv").read_text().split()
    rows = [f"cam2_{int(row.split(',')[0]):02d}.png{row[row.index(',') :]}" for row in rows]
    (work / "joints.csv").write_text("\n".join([names.replace("pose", "image"), *rows]))
    robot = ["--robot", work / "joints.csv", "--model", "ur3e", "--eye", "to-hand", "--rig", work / "rig.json"]
    return [*robot, *pairs[:4], "--target", work / "rig.board.toml"]


#: Recording -> its folder, its arguments, what is said of it, m, under which name, and its target, mm.
REAL = {
    "kuka2": (
        "handeye/kuka2",
        kuka2,
        (
            ("mean, the mounting that suits the nominal arm", "held_out_nominal_mean_m", 0.42),
            ("mean, with the arm's error that the others show", "held_out_geometry_mean_m", 0.42),
        ),
    ),
    "open3dv": ("real/open3dv-discs", open3dv, (("mean", "held_out_mean_m", 0.60),)),
    "ur3a": (
        "real/ur3a",
        ur3a,
        (
            ("RMS, nominal arm, the mounting that suits it", "held_out_nominal_rms_m", 1.3),
            ("RMS, with the arm's error that the others show", "held_out_geometry_rms_m", 1.0),
        ),
    ),
}


def real(names: list[str]) -> None:
    """Print the errors on poses left out of real recordings, by the command alone."""
    data = os.environ.get("ARMSIGHT_DATA")
    if data is None:
        raise SystemExit("ARMSIGHT_DATA is not set: it names the folder of the real recordings")
    for name in names or list(REAL):
        if name not in REAL:
            raise SystemExit(f"no recording {name!r}; there are {', '.join(REAL)}")
        folder, arguments, figures = REAL[name]
        if not (Path(data) / folder).is_dir():
            print(f"{name}: not measured: {Path(data) / folder} is missing")
            continue
        with tempfile.TemporaryDirectory() as work:
            answer = command("handeye", *arguments(Path(data), Path(work)))
        for what, key, target_mm in figures:
            print(f"{name}: {what} {1e3 * answer[key]:.2f} mm on poses left out (target {target_mm:.2f})", flush=True)
        unused = ", ".join(pose["name"] for pose in answer["poses"] if not pose["used"]) or "none"
        print(f"{name}: structure of the noise: {answer['noise']['structure']}; blunders: {unused}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tier", default="smoke", help="smoke or small")
    parser.add_argument("--seed", type=int, default=16180, help="another than KinHEC's own")
    parser.add_argument("--data", type=Path, help="sequences made before, in place of --tier and --seed")
    parser.add_argument("--tracks", nargs="*", help="only these")
    parser.add_argument(
        "--joints", action="store_true", help="armsight is given the joint angles and the nominal model too"
    )
    parser.add_argument("--limit", type=int, help="the first so many of each track")
    parser.add_argument("-o", "--output", type=Path, help="write every sequence's figures, JSON")
    parser.add_argument("--real", nargs="*", metavar="NAME", help=f"real recordings instead: {', '.join(REAL)}")
    given = parser.parse_args()
    if given.real is not None:
        real(given.real)
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.data or Path(temporary)
        if given.data is None:
            generated(given.tier, given.seed, folder)
        rows = evaluate(folder, given.tracks, given.limit, given.joints)
    print("\n" + "\n".join(summary(rows)))
    if given.output is not None:
        given.output.write_text(json.dumps([asdict(row) for row in rows]))


if __name__ == "__main__":
    main()
