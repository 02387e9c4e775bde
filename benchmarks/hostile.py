"""What happens when a file is hostile or huge: one line, exit code 2, and bounded memory, for every kind that is read.

    python benchmarks/hostile.py [WORD ...]      # only the cases whose names hold one of the words

Each case is a command in a process of its own. Its memory is what it had at most (VmHWM of the process, MB), beside that of
the same command with a file that is not there, which is what Python, numpy and OpenCV take. Nothing of armsight is imported
here: a child inherits the memory of its parent in this count.
"""

from __future__ import annotations

import gzip
import io
import os
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from pathlib import Path

#: More memory than without the file, MB, and time, s, that a case may take on a computer under load.
MOST_MB, MOST_S = 300.0, 300.0
BOARD = "chessboard:9x6:25mm"
#: Command for each kind of file; FILE is the file.
COMMANDS = {
    "rig": ("rig", "show", "FILE"),
    "imported rig": ("rig", "import", "FILE", "-o", "out.json"),
    "body": ("body", "check", "FILE"),
    "arm table": ("arm", "show", "FILE"),
    "table of poses": ("identify", "--arm", "six_r", "--data", "FILE"),
    "robot's poses": ("handeye", "--robot", "FILE", "--seen", "seen.csv", "--eye", "to-hand"),
    "video": ("record", "video:FILE", "-o", "out"),
    "recording": ("record", "bag:FILE", "-o", "out"),
    "image": ("calibrate", "--source", "pairs:FILE,FILE", "--target", BOARD, "-o", "out.json"),
    "check": ("check", "FILE"),
}
#: Suffixes that lead to other readers of a kind.
SUFFIXES = {
    "rig": (".json",),
    "imported rig": (".yaml", ".xml", ".npz", ".yml.gz", ".mat"),
    "body": (".toml", ".csv"),
    "arm table": (".toml", ".urdf"),
    "table of poses": (".csv",),
    "robot's poses": (".csv", ".json", ".yaml"),
    "video": (".mp4",),
    "recording": (".bag", ".db3", ".mcap"),
    "image": (".png", ".tif"),
    "check": (".csv",),
}


def png(width: int, height: int) -> bytes:
    """Return a PNG of black pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, rows = zlib.compressobj(9), b""
    for _ in range(height):
        rows += packer.compress(bytes(width + 1))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows + packer.flush()) + chunk(b"IEND", b"")


def tiff(width: int, height: int) -> bytes:
    """Return a TIFF that says a size, and holds nothing."""
    tags = ((256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, height), (279, 8))
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", 0)


def npz() -> bytes:
    """Return an archive of 4 GB of zeros."""
    out = io.BytesIO()
    head = (
        b"\x93NUMPY\x01\x00v\x00{'descr': '|u1', 'fortran_order': False, 'shape': (4000000000,), }".ljust(127) + b"\n"
    )
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("K.npy", "w", force_zip64=True) as file,
    ):
        file.write(head)
        for _ in range(4000):
            file.write(bytes(1_000_000))
    return out.getvalue()


def mcap(size: int, said: int) -> bytes:
    """Return an MCAP file with a chunk of zeros, by zstd, that says another size."""
    import zstandard

    packed = zstandard.compress(bytes(size))
    body = (
        struct.pack("<QQQI", 0, 1, said, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    )
    head = struct.pack("<II", 0, 0)
    return b"\x89MCAP0\r\n\x01" + struct.pack("<Q", len(head)) + head + b"\x06" + struct.pack("<Q", len(body)) + body


def parquet() -> bytes:
    """Return a Parquet table of 300 million equal times."""
    import pyarrow as pa
    from pyarrow import parquet as written

    out = io.BytesIO()
    zeros = pa.array([0.0] * 1_000_000)
    with written.ParquetWriter(
        out, pa.schema([(n, pa.float64()) for n in ("timestamp", "episode_index", "frame_index")])
    ) as w:
        for _ in range(100):
            w.write_table(pa.table(dict.fromkeys(("timestamp", "episode_index", "frame_index"), zeros)))
    return out.getvalue()


TABLES = ("table of poses", "robot's poses", "check")
#: Content -> the bytes, and the kinds of files it is given as.
BOMBS = {
    "PNG of 900 Mpx": (lambda: png(30_000, 30_000), {"image": ".png"}),
    "TIFF of 16 Gpx": (lambda: tiff(131_072, 131_072), {"image": ".tif"}),
    "4 GB in an npz": (npz, {"imported rig": ".npz"}),
    "1 GB in a gz": (lambda: gzip.compress(bytes(1_000_000_000), 9), {"imported rig": ".yml.gz", "robot's poses": ".csv"}),
    "chunk of 2 GB": (lambda: mcap(1_000_000_000, 2_000_000_000), {"recording": ".mcap"}),
    "chunk of 1 GB said to be 1 kB": (lambda: mcap(1_000_000_000, 1000), {"recording": ".mcap"}),
    "record of 3 GB": (lambda: b"\x89MCAP0\r\n\x09" + struct.pack("<Q", 3_000_000_000), {"recording": ".mcap"}),
    "7 MB of [": (lambda: b"[" * 7_000_000, dict.fromkeys(("rig", "robot's poses"), ".json")),
    "8 MB of []": (lambda: b"[" + b"[]," * 2_600_000 + b"[]]", dict.fromkeys(("rig", "robot's poses"), ".json")),
    "7 MB of - ": (lambda: b"- " * 3_500_000, {"imported rig": ".yaml", "robot's poses": ".yaml"}),
    "aliases of aliases": (
        lambda: b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
            b"%c: &%c [" % (k, k) + b",".join([b"*%c" % (k - 1)] * 9) + b"]\n" for k in range(98, 112)),
        {"imported rig": ".yaml", "robot's poses": ".yaml"}),
    "entities of entities": (
        lambda: b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "xxxxxxxxxx">' + b"".join(
            b'<!ENTITY %c "' % k + b"&%c;" % (k - 1) * 10 + b'">' for k in range(98, 112)) + b"]><robot>&o;</robot>",
        {"arm table": ".urdf", "imported rig": ".xml"}),
    "8 MB of <a/>": (lambda: b"<robot>" + b"<a/>" * 1_900_000 + b"</robot>", {"arm table": ".urdf"}),
    "60 MB of lines": (lambda: b"a\n" * 30_000_000, dict.fromkeys(TABLES, ".csv")),
    "60 MB in a line": (lambda: b"1," * 30_000_000, dict.fromkeys((*TABLES, "body"), ".csv")),
    "number of 7 MB": (lambda: b'{"format": ' + b"9" * 7_000_000 + b"}", {"rig": ".json"}),
    "TOML number of 7 MB": (lambda: b"a = " + b"9" * 7_000_000, {"body": ".toml", "arm table": ".toml"}),
    "playlist": (lambda: b"#EXTM3U\n#EXTINF:1,\n/dev/zero\n#EXT-X-ENDLIST\n", {"video": ".mp4"}),
    "concat script": (lambda: b"ffconcat version 1.0\nfile /dev/zero\n", {"video": ".mp4"}),
}  # fmt: skip


def ran(command: tuple[str, ...], folder: Path) -> tuple[int, str, float, float]:
    """Run a command; return its exit code, stderr, most memory, MB, and time, s."""
    code = (
        "import sys, atexit\nfrom armsight.app.main import main\n"
        "atexit.register(lambda: open('hwm', 'w').write(open('/proc/self/status').read()))\nmain()"
    )
    began = time.monotonic()
    (folder / "hwm").unlink(missing_ok=True)
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, *command],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=MOST_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return -1, "no end", float("nan"), MOST_S
    lines = (folder / "hwm").read_text().splitlines() if (folder / "hwm").exists() else []
    most = [float(line.split()[1]) / 1000 for line in lines if line.startswith("VmHWM")]
    return done.returncode, done.stderr, most[0] if most else float("nan"), time.monotonic() - began


def cases(folder: Path):
    """Yield the name of each case and its command; its file is made."""
    os.mkfifo(folder / "pipe")
    (folder / "seen.csv").write_text("x_m,y_m,z_m,qw,qx,qy,qz\n0,0,1,1,0,0,0\n")
    with (folder / "huge").open("wb") as file:
        file.truncate(6_000_000_000)
    for kind, suffixes in SUFFIXES.items():
        for suffix in suffixes:
            for name, target in (("/dev/zero", "/dev/zero"), ("a pipe", "pipe"), ("6 GB", "huge")):
                if kind in ("video", "recording") and name == "6 GB" and suffix != ".mcap":
                    continue  # of any size
                path = folder / f"{name.strip('/').replace('/', '-')}{suffix}"
                path.unlink(missing_ok=True)
                path.symlink_to(target if target.startswith("/") else folder / target)
                yield f"{name} as {kind} ({suffix})", tuple(c.replace("FILE", path.name) for c in COMMANDS[kind])
    dataset = folder / "dataset"
    for part in ("meta", "data"):
        (dataset / part).mkdir(parents=True)
    for content, (made, kinds) in BOMBS.items():
        data = made()
        for kind, suffix in kinds.items():
            path = folder / f"bomb{suffix}"
            path.write_bytes(data)
            yield f"{content} as {kind}", tuple(c.replace("FILE", path.name) for c in COMMANDS[kind])
    features = '{"left": {"dtype": "video"}, "right": {"dtype": "video"}}'
    (dataset / "meta" / "info.json").write_text(
        f'{{"codebase_version": "v3.0", "features": {features}, "video_path": "a"}}'
    )
    (dataset / "data" / "a.parquet").write_bytes(parquet())
    yield "100 million rows in a LeRobot dataset", ("record", "lerobot:dataset", "-o", "out")
    (dataset / "data" / "a.parquet").unlink()
    os.mkfifo(dataset / "data" / "a.parquet")
    yield "a pipe in a LeRobot dataset", ("record", "lerobot:dataset", "-o", "out")
    (folder / "bag").mkdir()
    os.mkfifo(folder / "bag" / "metadata.yaml")
    (folder / "bag" / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
    yield "a pipe as metadata.yaml", ("record", "bag:bag", "-o", "out")


def main() -> int:
    """Run all cases, and print what is not as it should be."""
    only, bad, count, worst = sys.argv[1:], 0, 0, 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        base = {
            kind: ran(tuple(c.replace("FILE", f"none{SUFFIXES[kind][0]}") for c in command), folder)[2]
            for kind, command in COMMANDS.items()
        }
        print("without a file, MB:", ", ".join(f"{kind} {most:.0f}" for kind, most in base.items()), flush=True)
        for case, command in cases(folder):
            if only and not any(word in case for word in only):
                continue
            code, said, most, took_s = ran(command, folder)
            kind = next((kind for kind in COMMANDS if f"as {kind}" in case), "recording")
            more, lines = most - base[kind], said.strip().splitlines()
            good = code == 2 and len(lines) == 1 and more <= MOST_MB and "Traceback" not in said
            count, bad, worst = count + 1, bad + (not good), max(worst, more)
            said = lines[-1][:150] if lines else ""
            print(
                f"{'ok    ' if good else 'MISSED'}  {case}: {code}, {more:+.0f} MB, {took_s:.1f} s: {said}", flush=True
            )
    print(f"{count - bad} of {count} end with one line and 2; at most {worst:.0f} MB more than without a file")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
