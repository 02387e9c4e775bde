"""``armsight export``: the tables of a run in another form."""

from __future__ import annotations

from pathlib import Path

import click

from armsight.app.options import JSON, argument, declared, option, out
from armsight.app.show.messages import note, print_answer

FORMS = ("csv", "parquet", "mcap", "tum", "ros2")


@click.command("export")
@declared
def command(
    run: str = argument("RUN"),
    form: str = option("The form.", "--to", choices=FORMS),
    output: Path = out("OUT", "New or empty folder; with --to mcap a file."),
    as_json: bool = JSON,
) -> None:
    """Write the tables of a run or a recording in another form: CSV, Parquet, MCAP, TUM or a ROS 2 bag.

    RUN is the folder of armsight run, demo or record, or its run.mcap. csv and parquet: poses, the live track, joints. tum:
    one file a track, for evo. mcap: the same file, compressed with zstd. ros2: a bag (MCAP) with images, camera_info,
    odometry, joint states and tf.
    """
    from armsight.app.export.bags import write_mcap, write_ros2
    from armsight.app.export.tables import write_csv, write_parquet, write_tum
    from armsight.app.replay.recorded import read_run, run_file
    from armsight.errors import InputError
    from armsight.files import check_folder, check_writable

    if form == "mcap":
        check_writable(output, apart_from=(run,))
    else:
        check_folder(output)
    output = output.expanduser()
    if output.exists() and (output.is_file() or any(output.iterdir())):
        raise InputError(f"{output}: is there already; give a new name")
    file = run_file(run)
    if file is None:
        what = "no run.mcap there" if Path(run).expanduser().exists() else "no such file or folder"
        raise InputError(f"{run}: {what}; give the folder of a run, or a file .mcap")
    if form in ("mcap", "ros2"):
        files = {"mcap": write_mcap, "ros2": write_ros2}[form](file, output)
    else:
        recorded = read_run(file)
        if recorded is None:
            raise InputError(f"{file}: not written by armsight; its poses come from armsight replay")
        note(*recorded.notes)
        files = {"csv": write_csv, "parquet": write_parquet, "tum": write_tum}[form](recorded, output)
    answer = {"run": run, "to": form, "files": [str(path) for path in files]}
    print_answer(as_json, answer, *map(str, files))
