"""batch report: a cell that differs, one that changes, and none among cells of which none does."""

import json
from dataclasses import replace

import numpy as np
import pytest

from armsight.app.batch.report import report, to_json
from armsight.errors import InputError
from cli_runs import assert_rejected

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("distributed")

CELLS, RUNS, SHOTS = 12, 10, 8


def batch(folder, seed, change=lambda cell, run: 0.0, missed=lambda cell: 0.1, a_day=1, runs=RUNS, arms=0):
    """Write the tables of a batch: residuals in which cells differ by 5 %, days by 3 %, shots by 20 %.

    With arms, cells have one of so many, and another rig from the fifth run on; without, each cell has one rig.
    """
    rng = np.random.default_rng(seed)
    recordings, shots = [], {"recording": [], "status": [], "residual_rms_m": []}
    own = 0.05 * rng.standard_normal(CELLS)
    for cell in range(CELLS):
        for run in range(runs):
            name = f"s3://bucket/lab/2026-11-{run // a_day + 1:02d}/c{cell:02d}/run{run}/run.mcap"
            row = {"recording": name, "status": "ok", "reason": None, "rig": f"2026-10-{cell + 1:02d} 0"}
            if arms:
                row |= {"arm": f"arm{cell % arms}", "rig": f"2026-{10 + (run > 4)}-{cell + 1:02d} 0"}
            recordings.append(row)
            if run % a_day == 0:
                day = 0.03 * rng.standard_normal()
            for _ in range(SHOTS):
                miss = rng.random() < missed(cell)
                size = 1 + own[cell] + day + change(cell, run) + 0.2 * rng.standard_normal()
                shots["recording"].append(name)
                shots["status"].append("missed" if miss else "ok")
                shots["residual_rms_m"].append(None if miss else 1e-4 * size)
    folder.mkdir(exist_ok=True)
    parquet.write_table(pa.Table.from_pylist(recordings), folder / "recordings.parquet")
    columns = {
        name: pa.array(values, pa.float64() if name.endswith("_m") else pa.string()) for name, values in shots.items()
    }
    parquet.write_table(pa.table(columns), folder / "shots.parquet")
    return folder


def named(rows):
    return {(row.name, row.metric) for row in rows if row.named}


def test_a_cell_that_differs_is_named_alone(tmp_path):
    rows = report(batch(tmp_path / "b", 1, lambda cell, run: 1.0 * (cell == 3)))
    assert named(rows) == {("c03", "residual_mm")}
    assert rows[0].median == pytest.approx(0.2, rel=0.2)
    assert rows[0].siblings == pytest.approx(0.1, rel=0.1)


def test_a_cell_that_changes_from_day_to_day_is_named(tmp_path):
    rows = report(batch(tmp_path / "b", 2, lambda cell, run: 0.1 * run * (cell == 5)))
    assert named(rows) == {("c05", "residual_mm")}
    assert rows[0].per_day == pytest.approx(0.01, rel=0.4)


def test_an_arm_that_changes_and_a_rig_that_differs_are_named(tmp_path):
    """Six arms, two cells each, of which one wears; the second rig of a cell is calibrated badly."""
    wrong = lambda cell, run: 0.1 * run * (cell % 6 == 2) + 2.0 * (cell == 4 and run > 4)  # noqa: E731
    rows = report(batch(tmp_path / "b", 4, wrong, arms=6))
    (worn,) = [row for row in rows if row.named and row.by == "arm"]
    assert (worn.name, worn.runs) == ("arm2", 2 * RUNS)
    assert worn.per_day == pytest.approx(0.01, rel=0.4)
    assert {row.name for row in rows if row.named and row.by == "rig" and row.median > 0.25} == {"2026-11-05 0"}
    assert {row.by for row in report(batch(tmp_path / "c", 4))} == {"cell"}  # a rig a cell says the same as cells


def test_a_cell_that_misses_more_is_named(tmp_path):
    rows = report(batch(tmp_path / "b", 3, missed=lambda cell: 0.7 if cell == 7 else 0.1))
    assert ("c07", "missed") in named(rows)


@pytest.mark.parametrize(
    "how",
    [{}, {"missed": lambda cell: 0.01}, {"a_day": 5, "runs": 30}, {"arms": 6}],
    ids=["as it is", "few missed", "many a day", "with arms and rigs"],
)
def test_where_no_cell_differs_few_reports_name_one(tmp_path, how):
    """5 % of reports may; of 20 more than 3 have a chance of 1.6 %, and of 99.6 % where each cell had 5 %."""
    false = sum(bool(named(report(batch(tmp_path / "b", 100 + seed, **how)))) for seed in range(20))
    assert false <= 3


def test_a_chance_that_is_zero_is_the_smallest(tmp_path):
    row = report(batch(tmp_path / "b", 1))[0]
    assert replace(row, chance=None, chance_trend=0.0).named
    assert not replace(row, chance=None, chance_trend=None).named


def test_json_and_what_is_no_batch(tmp_path, armsight):
    folder = batch(tmp_path / "b", 1, lambda cell, run: 1.0 * (cell == 3))
    printed = armsight("batch", "report", folder, "--json")
    assert json.loads(printed.out) == json.loads(json.dumps(to_json(report(folder))))
    assert armsight("batch", "report", folder).out.splitlines()[1].startswith("lab/c03 residual_mm: 0.19")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no results of armsight batch"):
        report(tmp_path / "empty")
    assert_rejected(armsight("batch", "report", folder, tmp_path), "one batch")
    assert_rejected(armsight("batch", "measure", "x.bag"), "give -o DIR")
