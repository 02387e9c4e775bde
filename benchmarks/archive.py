"""An archive of many cells: is the report the same, whoever computes it?

    python archive.py 1000     so many runs of 20 cells; batch replay by 1, 2 and 4 workers, killed and started again, and
                               from s3:// (a moto server, pip install "moto[server]" s3fs); compares the bytes of reports

The runs are pieces of one demo's run.mcap, each longer than the last.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

CELLS = 20
#: Length of the shortest piece, and what each is longer than the last, s.
FIRST_S, STEP_S = 1.0, 0.001
ARMSIGHT = (sys.executable, "-m", "armsight")


def pieces(source, count, folder):
    """Write the runs as armsight hub push lays them: SITE/DAY/CELL/RUN/run.mcap."""
    with source.open("rb") as file:
        reader = make_reader(file)
        metadata = list(reader.iter_metadata())
        summary = reader.get_summary()
        begin = summary.statistics.message_start_time
        end = begin + int(1e9 * (FIRST_S + count * STEP_S))
        kept = [
            each for each in reader.iter_messages(end_time=end, log_time_order=True)
            if each[1].topic.startswith("/armsight/")
        ]  # fmt: skip
    for number in range(count):
        run = folder / f"site/2026-11-{number // CELLS % 28 + 1:02d}/c{number % CELLS:02d}/run{number // CELLS:02d}"
        run.mkdir(parents=True)
        with (run / "run.mcap").open("wb") as file:
            writer, channels = Writer(file), {}
            writer.start()
            for each in metadata:
                writer.add_metadata(each.name, each.metadata)
            for schema, channel, message in kept:
                if message.log_time > begin + 1e9 * (FIRST_S + number * STEP_S):
                    break
                if channel.id not in channels:
                    of = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                    channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of)
                writer.add_message(
                    channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                )
            writer.finish()
        shutil.copy(source.with_name("summary.json"), run)


def replayed(pattern, output, workers):
    """Return the process of a batch."""
    command = [*ARMSIGHT, "batch", "replay", pattern, "-o", output, "--workers", str(workers)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def report(output):
    """Return the report of a batch, as bytes."""
    return subprocess.run([*ARMSIGHT, "batch", "report", output, "--json"], check=True, capture_output=True).stdout


def stored(folder):
    """Put the archive into a bucket of a moto server, and return its URL."""
    import s3fs
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    host, port = server.get_host_and_port()
    os.environ |= {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "a", "AWS_DEFAULT_REGION": "us-east-1"}
    os.environ["AWS_ENDPOINT_URL"] = f"http://{host}:{port}"
    store = s3fs.S3FileSystem()
    store.mkdir("archive")
    store.put(str(folder / "site"), "archive/site", recursive=True)
    return "s3://archive/**/run.mcap"


def main(count):
    """Replay and compare."""
    folder = Path(tempfile.mkdtemp())
    subprocess.run([*ARMSIGHT, "demo", "--quick"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    pieces(folder / "demo/run.mcap", count, folder / "archive")
    pattern, found = f"{folder}/archive/**/run.mcap", {}
    for label, workers in (("1 worker", 1), ("2 workers", 2), ("4 workers", 4), ("killed", 2), ("s3://", 2)):
        output, began = folder / label.replace("/", ""), time.monotonic()
        if label == "s3://":
            pattern = stored(folder / "archive")
        process = replayed(pattern, output, workers)
        if label == "killed":
            while process.poll() is None and len(list(output.glob("parts/*"))) < count / 3:
                time.sleep(0.1)
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            label = f"killed after {len(list(output.glob('parts/*')))} runs, and started again"
            process = replayed(pattern, output, workers)
        code = process.wait()
        found[label] = report(output)
        print(
            f"{label}: exit code {code}, report {len(found[label])} bytes, {time.monotonic() - began:.0f} s", flush=True
        )
    print("the same bytes" if len(set(found.values())) == 1 else "REPORTS DIFFER")


if __name__ == "__main__":
    PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    PARSER.add_argument("runs", type=int, nargs="?", default=1000)
    main(PARSER.parse_args().runs)
