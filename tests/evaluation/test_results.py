"""Files of an output folder: columns of `metrics.csv`, content of `manifest.json`."""

import csv
import json

from asp_env.evaluation.results import Row, write_manifest, write_metrics

COLUMNS = (
    "data,predictor,trained_on,view,recipe,chaining,planner,traffic,latency_ticks,horizon_s,"
    "selection,subset,metric,value,low,high,n,rules,runs,mde,p_holm"
)


def test_columns_of_the_metrics(tmp_path):
    """The exact header; empty cells where a column does not apply; six digits."""
    rows = [
        Row(data="x,y", predictor="oracle", metric="FDE", value=1 / 3, n=7, horizon_s=3.0),
        Row(
            data="d",
            planner="idm",
            traffic="log",
            latency_ticks=0,
            subset="left",
            metric="score",
            value=0.5,
            low=0.25,
            high=0.75,
            n=2,
            rules="nuplan 1",
            runs=3,
            mde=0.28,
            p_holm=0.01,
        ),
    ]
    write_metrics(tmp_path, rows)
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines == [
        COLUMNS,
        '"x,y",oracle,,,,,,,,3,,all,FDE,0.333333,,,7,,,,',
        "d,,,,,,idm,log,0,,,left,score,0.5,0.25,0.75,2,nuplan 1,3,0.28,0.01",
    ]
    with (tmp_path / "metrics.csv").open(newline="") as file:
        assert [row["n"] for row in csv.DictReader(file)] == ["7", "2"]


def test_a_manifest_repeats_byte_for_byte(tmp_path):
    """It contains command, configuration and versions, but no time and no machine."""
    texts = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_manifest(tmp_path / name, "drive", data="d", seeds=[0, 1])
        texts.append((tmp_path / name / "manifest.json").read_text())
    assert texts[0] == texts[1]
    manifest = json.loads(texts[0])
    assert (manifest["command"], manifest["data"], manifest["seeds"]) == ("drive", "d", [0, 1])
    assert {"python", "numpy", "gymnasium", "asp-env"} <= set(manifest["versions"])
