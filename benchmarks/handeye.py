"""Hand-eye calibration beside the baselines of KinHEC, track by track, on sequences whose truth is known.

    pip install kinhec==1.1 pandas pyarrow pyyaml
    python benchmarks/handeye.py --tier small --seed 16180 -o kinhec.json

KinHEC (MIT) makes pose streams of arms and cameras: noise, degenerate motions, clock offsets, blunders, unknown scale,
wrong kinematics, PnP. Its baselines get what its own protocol gives them (keyframes; the clock offset by correlation);
armsight gets the two streams. A sequence counts in the comparison where armsight answers; what it refuses is counted
apart, with what the baselines answer there.

Per track: median error of X, mm and degrees, ours and of each baseline; how often the ellipsoid of 95 % of X holds the
truth; the median NEES (5.35 with six degrees of freedom is honest); refusals; the error of the clock offset.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import yaml
from scipy.stats import chi2

from armsight.errors import ArmsightError
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.handeye.handeye import Poses
from armsight.loop.handeye.streams import PoseStream, calibrate_structured_streams
from armsight.loop.handeye.structured import calibrate_structured

#: A motion is degenerate where the second eigenvalue of KinHEC's scatter of rotation axes is below this: parallel axes.
DEGENERATE = 1e-6


@dataclass
class Row:
    """One sequence.

    Attributes:
        translation_mm, rotation_deg: errors of X; NaN where refused.
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
    refused: str = ""
    seconds: float = 0.0
    peers: dict[str, tuple[float, float]] = field(default_factory=dict)


def _links(sequence, seen) -> np.ndarray | None:
    """T_link_flange by the joints read and the arm's nominal model; None for a body that no arm moves."""
    from kinhec.kinematics import forward_kinematics_all
    from kinhec.robots import get_robot

    if sequence.robot.q_meas is None:
        return None
    robot = get_robot(sequence.manifest["robot"])
    frames = np.array([forward_kinematics_all(robot, q) for q in sequence.robot.q_meas[seen]])
    return inverse(frames) @ frames[:, -1:]


def ours(sequence, row: Row, joints: bool) -> None:
    """Calibrate a sequence by armsight alone; with ``joints`` the joint angles and the arm's model are known too."""
    seen = sequence.camera.has_measurement
    B, t = sequence.camera.T_cam_target_meas[seen], sequence.camera.t[seen]
    eye = "in_hand" if sequence.eye_in_hand else "to_hand"
    ordered = sequence.manifest["sampling_mode"] == "continuous"
    started = time.perf_counter()
    try:
        if sequence.synchronous:
            A = sequence.robot.T_base_ee_meas[seen]
            poses = Poses(A, B, np.zeros((len(A), 6, 6)), eye == "in_hand", np.zeros(3))
            links = _links(sequence, seen) if joints else None
            found = calibrate_structured(poses, t_s=t if ordered else None, links=links, scale=True)
        else:
            hand = PoseStream.of(sequence.robot.t, sequence.robot.T_base_ee_meas, "hand")
            streams = calibrate_structured_streams(hand, PoseStream.of(t, B, "eye"), eye=eye, scale=True)
            found = streams.handeye
            row.offset_ms = 1e3 * abs(-streams.offset_s - sequence.time_offset)
    except ArmsightError as error:
        row.refused = str(error)
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
            f"{row.seconds:5.1f} s {row.structure} {row.refused[:60]}",
            flush=True,
        )
    return rows


def _median(values) -> float:
    found = [v for v in values if np.isfinite(v)]
    return float(np.median(found)) if found else float("nan")


def summary(rows: list[Row]) -> list[str]:
    """Return the tables."""
    lines = [
        "| track | sequences | refused | mm | deg | best baseline by mm | its mm | by deg | its deg | in 95 % | NEES | s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    tracks = list(dict.fromkeys(row.track for row in rows))
    for track in tracks:
        of = [row for row in rows if row.track == track]
        done = [row for row in of if not row.refused]
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
    refused = [row for row in rows if row.refused]
    offsets = [row for row in rows if np.isfinite(row.offset_ms)]
    peers_there = _median(min((e[0] for e in row.peers.values()), default=np.nan) for row in refused)
    lines += [
        "",
        f"degenerate motions: {len(degenerate)}, of which refused {sum(bool(r.refused) for r in degenerate)}; refused "
        f"though not degenerate: {sum(not r.degenerate for r in refused)}; median of the best baseline where refused: "
        f"{peers_there:.1f} mm",
        f"clock offset, {len(offsets)} sequences: median {_median(r.offset_ms for r in offsets):.3f} ms; KinHEC's "
        f"correlation {_median(r.peer_offset_ms for r in offsets):.3f} ms",
    ]
    return lines


def generated(tier: str, seed: int, folder: Path) -> None:
    """Make a tier's sequences with a seed of our own; what is there already is kept."""
    import kinhec
    from kinhec.cli import main

    spec = yaml.safe_load((Path(kinhec.__file__).parent / "configs" / f"{tier}.yaml").read_text())
    spec["global_seed"] = seed
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tier.yaml").write_text(yaml.safe_dump(spec))
    main(
        ["generate", "--tier", str(folder / "tier.yaml"), "--out", str(folder), "--no-card", "--work-dir", str(folder)]
    )


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
    given = parser.parse_args()
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
