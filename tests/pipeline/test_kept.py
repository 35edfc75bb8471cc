"""A long stage that was interrupted goes on where it stopped, and ends with the same rows."""

import math
from pathlib import Path

import pytest

from constraint_geodesics.params import ComputeParams, load_params
from constraint_geodesics.pipeline import code
from constraint_geodesics.pipeline.compute import ComputeError
from constraint_geodesics.pipeline.kept import Rows, kept_folder, kept_map
from constraint_geodesics.pipeline.layout import Layout

ROOT = Path(__file__).parents[2]
ONE = ComputeParams(backend="loky", workers=1)


def rows_of(item: tuple[int, Path]) -> Rows:
    number, folder = item
    (folder / f"asked-{number}").write_text((folder / f"asked-{number}").read_text() + "x")
    if number == 2 and not (folder / "go").exists():
        raise ValueError("interrupted")
    return [{"number": number, "value": 1.0 / (1 + number), "none": math.nan, "name": "a, b"}]


def test_what_is_done_is_not_done_again_and_comes_out_the_same(tmp_path) -> None:
    items = [(number, tmp_path) for number in range(4)]
    for number, _ in items:
        (tmp_path / f"asked-{number}").write_text("")
    with pytest.raises(ComputeError, match="interrupted"):
        kept_map(rows_of, items, tmp_path / "kept", ONE, description="")
    (tmp_path / "go").touch()
    (tmp_path / "kept" / "1.json").write_text("[{")  # cut short
    found = kept_map(rows_of, items, tmp_path / "kept", ONE, description="")
    assert [len((tmp_path / f"asked-{number}").read_text()) for number in range(4)] == [1, 2, 2, 1]
    assert [row["value"] for (row,) in found] == [1.0, 1.0 / 2.0, 1.0 / 3.0, 1.0 / 4.0]
    assert repr(kept_map(rows_of, items, tmp_path / "kept", ONE, description="")) == repr(found)


def test_rows_of_other_parameters_data_or_code_lie_elsewhere(tmp_path) -> None:
    layout, params = Layout(tmp_path), load_params(ROOT / "params.yaml")
    for name in ("data", "stages"):
        (tmp_path / name).mkdir()
    script = tmp_path / "stages" / "study.py"
    script.write_text("from constraint_geodesics import palette\n")
    folder = kept_folder(params, layout, "study", tmp_path / "data")
    assert folder == kept_folder(params, layout, "study", tmp_path / "data")
    changed = load_params(ROOT / "params.yaml", {"judge.spacing_rad": 0.03})
    others = {kept_folder(changed, layout, "study", tmp_path / "data")}
    (tmp_path / "data" / "rows.csv").write_text("1")
    others.add(kept_folder(params, layout, "study", tmp_path / "data"))
    script.write_text("from constraint_geodesics import palette, xml_files\n")
    code._imported.cache_clear()
    code._tree.cache_clear()
    code.digest.cache_clear()
    others.add(kept_folder(params, layout, "study", tmp_path / "data"))
    assert len({folder, *others}) == 4
