import copy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from dvc.utils.hydra import apply_overrides
from dvc.utils.serialize import modify_yaml

from constraint_geodesics.gate import check_params
from constraint_geodesics.params import ParamsError, WorkcellParams, load_params
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.capsule import Capsule

ROOT = Path(__file__).resolve().parents[1]
Change = Callable[[dict[str, Any]], Any]


def changed(tmp_path: Path, change: Change) -> Path:
    raw = copy.deepcopy(yaml.safe_load((ROOT / "params.yaml").read_text()))
    change(raw)
    file = tmp_path / "params.yaml"
    file.write_text(yaml.safe_dump(raw))
    return file


def shapes(raw: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = raw["workcell"]["shapes"]
    return found


PIPE = {"kind": "capsule", "from_m": [0, 0, 1], "to_m": [1, 0, 1], "radius_m": 0.1}
BAD: list[tuple[Change, tuple[str, ...]]] = [
    (
        lambda p: p["constraints"]["level_cup_relaxed"].update(tolerance=[0, 0, 0, 4.0, 0.1, 0]),
        ("level_cup_relaxed", "tolerance[3]=4.0", "at most π"),
    ),
    (
        lambda p: p["unseen"]["shelf"].update(tolerance=[0, 0, 1e300, 0, 0, 0]),
        ("unseen.shelf.tolerance", "1e+300"),
    ),
    (lambda p: p["labels"].update(free_rows=10**12), ("labels.free_rows=1000000000000",)),
    (lambda p: p["policies"].update(steps=10**12), ("policies.steps=1000000000000",)),
    (lambda p: p["planner"].update(acceleration_rad_s2=1e300), ("acceleration_rad_s2=1e+300",)),
    (lambda p: p["planner"].update(clearance_m=5.0), ("planner.clearance_m=5.0",)),
    (lambda p: p["manifolds"]["paper"].update(hidden=[10**6]), ("paper.hidden", "65536")),
    (lambda p: p["manifolds"]["paper"].update(learning_rate=2.0), ("paper.learning_rate=2.0",)),
    (lambda p: p["geodesics"].update(seeds=[0, 0]), ("geodesics.seeds", "must differ")),
    (lambda p: p["geodesics"].update(seeds=[99]), ("geodesics.seeds=[99]", "policies.seeds")),
    (
        lambda p: p["policies"]["obstacles"].update(radii_m=[0.12, 0.05]),
        ("policies.obstacles", "radii_m=[0.12, 0.05]"),
    ),
    (lambda p: p["compute"].update(workers=10**6), ("compute.workers=1000000",)),
    (lambda p: p["compute"].update(dask_address="nowhere"), ("dask_address='nowhere'", "tcp://")),
    (lambda p: p["tracking"].update(experiment=" "), ("tracking.experiment",)),
    (lambda p: p["recording"].update(frames=10**9), ("recording.frames",)),
    (lambda p: p["compare_charts"].update(dims=[99]), ("compare_charts.dims", "64")),
    (lambda p: p["carried"].update(constraints=["cup"]), ("carried.constraints='cup'", "slide")),
    (lambda p: p.update(speed=1), ("speed=1", "no such parameter")),
    (lambda p: p["labels"].update(free_row=5), ("labels.free_row=5", "no such parameter")),
    (lambda p: p["labels"].update(free_rows="60"), ("labels.free_rows='60'", "integer")),
    (lambda p: p["labels"].update(free_rows=True), ("labels.free_rows=True", "integer")),
    (
        lambda p: p["labels"].update(free_rows=0),
        ("labels.free_rows=0", "greater than or equal to 1"),
    ),
    (
        lambda p: p["manifolds"]["paper"].update(beta=float("nan")),
        ("manifolds.paper.beta=nan", "finite"),
    ),
    (
        lambda p: p["constraints"]["slide"].update(axes=[0, 0, 2, 1, 1, 0]),
        ("constraints.slide.axes.2=2", "0 or 1"),
    ),
    (
        lambda p: p["constraints"]["slide"].update(tolerance=[0, 0, -1, 0, 0, 0]),
        ("constraints.slide.tolerance.2=-1",),
    ),
    (
        lambda p: p["constraints"]["slide"].update(tolerance=[1, 0, 0, 0, 0, 0]),
        ("constraints.slide", "axis is free"),
    ),
    (
        lambda p: p["constraints"]["slide"].update(reference=None),
        ("constraints.slide", "reference"),
    ),
    (
        lambda p: p["geodesics"].update(searched=["planer"]),
        ("geodesics.searched='planer'", "must be one of"),
    ),
    (
        lambda p: p["geodesics"]["reward"].update(form="best"),
        ("geodesics.reward.form='best'", "'corrected'"),
    ),
    (lambda p: p["geodesics"]["reward"].update(length_weight=0.9), ("geodesics.reward", "(0, 1]")),
    (lambda p: p["compute"].update(backend="dask"), ("compute", "dask_address")),
    (lambda p: p["recording"].update(queries=0), ("recording.queries=0", "equal to 1")),
    (lambda p: p["execution"].update(recorded=0), ("execution.recorded=0", "equal to 1")),
    (lambda p: p.pop("judge"), ("judge is missing",)),
    (lambda p: p["constraints"].pop("free"), ("constraints.free",)),
    (lambda p: shapes(p)["table"].pop("kind"), ("workcell.shapes.table.kind is missing",)),
    (lambda p: shapes(p)["table"].update(kind="cone"), ("workcell.shapes.table", "'capsule'")),
    (lambda p: shapes(p)["table"].update(size_m=[1, 1, 0]), ("box.size_m.2=0", "greater than 0")),
    (lambda p: shapes(p)["table"].update(centre_m=[0, 0, "1"]), ("box.centre_m.2='1'", "number")),
    (lambda p: shapes(p)["table"].update(radius_m=1), ("box.radius_m=1", "no such parameter")),
    (lambda p: shapes(p).update(pipe=PIPE | {"to_m": [0, 0]}), ("capsule.to_m.2 is missing",)),
    (lambda p: shapes(p).update(pipe=PIPE | {"radius_m": -1}), ("capsule.radius_m=-1",)),
]


@pytest.mark.parametrize(("change", "parts"), BAD)
def test_a_bad_parameter_is_named_in_one_line(
    tmp_path: Path, change: Change, parts: tuple[str, ...]
) -> None:
    with pytest.raises(ParamsError) as caught:
        load_params(changed(tmp_path, change))
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


FUNCTIONS = {"kind": "functions", "description": "own", "factory": "nowhere:f"}
DOOR = {"kind": "urdf", "urdf": "nowhere.urdf"}
REFUSED: list[tuple[Change, tuple[str, ...]]] = [
    (
        lambda p: p["constraints"]["slide"]["reference"].update(position_m=[9.0, 0.0, 0.2]),
        ("constraints: slide", "[9.0, 0.0, 0.2]", "1.2 m away"),
    ),
    (
        lambda p: p["constraints"]["slide"]["reference"].update(position_m=[0.0, 0.0, 1.15]),
        ("constraints: slide", "satisfy the constraint"),
    ),
    (lambda p: p["constraints"].update(own=FUNCTIONS), ("constraints: own", "nowhere:f")),
    (
        lambda p: shapes(p)["table"].update(centre_m=[0, 0, 0.3]),
        ("constraints: ", "free of collision"),
    ),
    (lambda p: p["demonstrations"].update(tasks=["tea"]), ("demonstrations.tasks='tea'", "cup")),
    (
        lambda p: p["robot"].update(limits_rad={"joint1": [1.0, -1.0]}),
        ("joint1", "[1.0, -1.0]", "a lower one"),
    ),
    (lambda p: p["robot"].update(hold={"joint9": 0.0}), ("robot", "joint9")),
    (lambda p: p["robot"].update(may_touch="no.srdf"), ("robot", "no.srdf")),
    (lambda p: p["robot"].update(urdf="no/arm.urdf"), ("robot", "no/arm.urdf", "no such URDF")),
    (
        lambda p: p["robot"].update(urdf="params.yaml"),
        ("robot: ", "params.yaml: the file is no XML", "no XML"),
    ),
    (lambda p: p["robot"].update(tool_link="hand"), ("robot", "there is no link 'hand'")),
    (lambda p: p["robot"].update(limits_rad={"elbow": [-1, 1]}), ("robot", "elbow", "joint6")),
    (
        lambda p: p["robot"].update(limits_rad={"joint1": [-9.0, 3.5]}),
        ("robot", "joint1", "[-9.0, 3.5]", "within the URDF's"),
    ),
    (lambda p: shapes(p).update(door=DOOR), ("workcell", "nowhere.urdf")),
    (lambda p: shapes(p)["table"].update(exempt_links=["arm"]), ("workcell", "arm")),
    (lambda p: p["carried"]["shapes"].update(door=DOOR), ("carried", "nowhere.urdf")),
    (
        lambda p: p["carried"]["shapes"].update(link5=p["workcell"]["shapes"]["table"]),
        ("carried", "link5"),
    ),
    (
        lambda p: p["manifolds"]["paper"].update(latent_dim=7),
        ("manifolds.paper.latent_dim=7", "at most 6"),
    ),
    (
        lambda p: p["geodesics"].update(searched=["paper"], illustrated=[]),
        ("geodesics.searched='paper'", "retract must be true"),
    ),
    (
        lambda p: p["policies"]["ppo"].update(batch_size=5000),
        ("policies.ppo.batch_size=5000", "at most 3072"),
    ),
    (lambda p: p["policies"].update(chart="paprika"), ("policies.chart='paprika'", "joint_space")),
    (lambda p: p["execution"].update(least_tilt_rad=4.0), ("execution.least_tilt_rad=4.0", "π")),
    (
        lambda p: p["studies"].update(constraint="free"),
        ("studies.constraint='free'", "roll and pitch"),
    ),
    (
        lambda p: p["benchmark"]["planners"]["BiRRT"].update(kind="omple"),
        ("benchmark.planners.BiRRT", "no kind 'omple'", "birrt"),
    ),
    (
        lambda p: p["benchmark"].update(drawn=["BiRTT"]),
        ("benchmark.drawn='BiRTT'", "must be one of"),
    ),
]


@pytest.mark.parametrize(("change", "parts"), REFUSED)
def test_the_gate_refuses_what_a_stage_would_fail_on(
    tmp_path: Path, change: Change, parts: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = changed(tmp_path, change)
    monkeypatch.chdir(tmp_path)
    params = load_params(file)
    with pytest.raises(ParamsError) as caught:
        check_params(params)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message


@pytest.mark.parametrize(
    ("host", "store", "good"),
    [
        ("127.0.0.1", None, True),
        ("[::1]", None, True),
        ("node7", None, False),
        ("node7", "sqlite:///runs.db", False),
        ("node7", "http://node7:5000", True),
    ],
)
def test_workers_on_other_machines_need_a_server_of_mlflow(
    tmp_path: Path, host: str, store: str | None, good: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each seed's worker reports; SQLite on a shared disk is no place for several machines."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    if store is not None:
        monkeypatch.setenv("MLFLOW_TRACKING_URI", store)
    dask = {"backend": "dask", "dask_address": f"tcp://{host}:8786"}
    params = load_params(changed(tmp_path, lambda p: p["compute"].update(dask)))
    if good:
        check_params(params)
        return
    with pytest.raises(ParamsError, match=r"dask_address='tcp://node7:8786'.*MLFLOW_TRACKING_URI"):
        check_params(params)


def test_an_experiment_changes_one_line(tmp_path: Path) -> None:
    """DVC writes the file anew; it must be as DVC writes it."""
    file = tmp_path / "params.yaml"
    text = (ROOT / "params.yaml").read_text().partition("\nplans:")[0]
    file.write_text(text)
    with modify_yaml(str(file)) as params:
        params["constraints"]["slide"]["tolerance"][2] = 0.01
    before, after = text.splitlines(), file.read_text().splitlines()
    assert len(before) == len(after)
    differing = [line for line, old in zip(after, before, strict=True) if line != old]
    assert differing == ["    tolerance: [0, 0, 0.01, 0, 0, 0]"]


def test_the_committed_parameters_are_good() -> None:
    params = load_params(ROOT / "params.yaml")
    check_params(params)
    assert params.constraints["level_cup"].axes == (0, 0, 0, 1, 1, 0)


@pytest.mark.parametrize(
    ("written", "meant"), [("2e-05", 2e-5), ("1E-6", 1e-6), ("3e2", 300.0), ("2.5e-5", 2.5e-5)]
)
def test_a_number_with_an_exponent_is_one_without_a_point_too(
    tmp_path: Path, written: str, meant: float
) -> None:
    file = tmp_path / "params.yaml"
    text = (ROOT / "params.yaml").read_text()
    assert text.count("  accuracy: 0.00001 ") == 1
    file.write_text(text.replace("  accuracy: 0.00001 ", f"  accuracy: {written} "))
    assert load_params(file).planner.accuracy == meant


def test_what_an_experiment_sets_is_read_as_dvc_wrote_it(tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text((ROOT / "params.yaml").read_text())
    apply_overrides(file, ["planner.accuracy=0.00001", "geodesics.ppo.learning_rate_end=1e-06"])
    assert "1e-05" in file.read_text()  # text in YAML 1.1
    params = load_params(file)
    assert (params.planner.accuracy, params.geodesics.ppo.learning_rate_end) == (1e-5, 1e-6)


@pytest.mark.parametrize("text", ["labels: [1", "labels: {}\nlabels: {}\n", "\tlabels: 1"])
def test_what_is_no_yaml_is_said_in_one_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(text)
    with pytest.raises(ParamsError, match="not YAML") as caught:
        load_params(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("stage", ["label_joints.py level_cup", "digest_code.py"])
def test_a_stage_stops_before_any_work(tmp_path: Path, stage: str) -> None:
    changed(tmp_path, lambda p: p["geodesics"]["ppo"].update(gamma=1.5))
    script, *names = stage.split()
    command = [sys.executable, str(ROOT / "stages" / script), *names]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr == (
        "error: params.yaml: geodesics.ppo.gamma=1.5: input should be less than or equal to 1\n"
    )
    assert [file.name for file in tmp_path.iterdir()] == ["params.yaml"]


def test_an_unknown_constraint_is_named(tmp_path: Path) -> None:
    changed(tmp_path, lambda p: None)
    command = [sys.executable, str(ROOT / "stages" / "label_joints.py"), "level_cap"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "level_cap" in result.stderr
    assert result.stderr.count("\n") == 1


def test_shapes_of_every_kind_come_from_params_and_go_back(tmp_path: Path) -> None:
    given = {
        "pipe": PIPE | {"exempt_links": ["link1"]},
        "lamp": {"kind": "sphere", "centre_m": [0.5, 0.0, 1], "radius_m": 0.1},
        "tray": {"kind": "urdf", "urdf": "tray/traybox.urdf", "rpy_rad": [0, 0, 1.5]},
    }
    workcell = load_params(changed(tmp_path, lambda p: shapes(p).update(given))).workcell
    assert set(workcell.shapes) == {"table", "pipe", "lamp", "tray"}
    assert workcell.shapes["pipe"] == Capsule("pipe", (0, 0, 1), (1, 0, 1), 0.1, ("link1",))
    assert workcell.shapes["tray"] == Body("tray", "tray/traybox.urdf", rpy_rad=(0, 0, 1.5))
    assert WorkcellParams.model_validate(workcell.model_dump(mode="json")) == workcell
    assert WorkcellParams().including(*workcell.shapes.values()) == workcell
