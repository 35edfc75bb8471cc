"""The experiments of docs/experiments.md on the cheapest stage and small parameters: the page's
commands run.
"""

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.end_to_end import smoke
from tests.test_docs import ROOT, words_of

pytestmark = pytest.mark.timeout(600)

PAGE = (ROOT / "docs" / "experiments.md").read_text()
COMMANDS = [
    words
    for block in re.findall(r"^```bash\n(.*?)^```", PAGE, re.S | re.M)
    for words in words_of(block)
]
NAME, STAGE = "printed-sphere", "train_analytic@plane"
REPORT, CURVES = "reports/train_analytic/plane.json", "reports/train_analytic/plane-learning.csv"
IN_PLACE = {
    "train_analytic@sphere": STAGE,
    "reports/train_analytic/sphere.json": REPORT,
    "reports/train_analytic/torus.json": REPORT,
    "reports/train_policies/joint_space-learning.csv": CURVES,
    "tilt-5": NAME,
    "tilt-5-temp": NAME,
}
"""What the small run has in place of the page's names."""


def ran(folder: Path, words: list[str]) -> str:
    environment = smoke.environment(folder) | {
        "GIT_AUTHOR_NAME": "smoke",
        "GIT_COMMITTER_NAME": "smoke",
    }
    environment |= {"GIT_AUTHOR_EMAIL": "smoke@localhost", "GIT_COMMITTER_EMAIL": "smoke@localhost"}
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{shlex.join(words)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def committed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A committed run of one stage, which is the whole pipeline there."""
    folder = tmp_path_factory.mktemp("experiments")
    smoke.copy_checkout(folder)
    smoke.shrink_params(folder)
    params = yaml.safe_load((folder / "params.yaml").read_text())
    params["geodesics"] |= {"seeds": [0], "analytic_steps": 640}
    (folder / "params.yaml").write_text(yaml.safe_dump(params, sort_keys=False))
    stages = yaml.safe_load((folder / "dvc.yaml").read_text())["stages"]
    (folder / "dvc.yaml").write_text(
        yaml.safe_dump({"stages": {n: stages[n] for n in ("digest_code", "train_analytic")}})
    )
    for name in ("dvc.yaml", "dvc.lock"):
        (folder / "stages" / name).unlink(missing_ok=True)
    ran(folder, ["dvc", "repro", STAGE])
    for words in (["git", "add", "-A"], ["git", "commit", "-q", "-m", "run"]):
        ran(folder, words)
    return folder


def of_the_page(*beginning: str, holding: str = "") -> list[str]:
    """The page's first command of a kind, on what the small run has."""
    found = [
        words
        for words in COMMANDS
        if words[: len(beginning)] == list(beginning) and holding in " ".join(words)
    ]
    assert found, beginning
    kept = [word for word in found[0] if not re.search(r"^reports/.*(cup|planner)\S*json", word)]
    return [IN_PLACE.get(word, word) for word in kept]


def test_an_experiment_is_run_compared_brought_back_and_undone(committed: Path) -> None:
    before = json.loads((committed / REPORT).read_text())
    assert "Running stage" in ran(committed, of_the_page("dvc", "exp", "run", holding=NAME))
    after = json.loads((committed / REPORT).read_text())
    assert after != before
    assert "geodesics.reward.form" in ran(committed, of_the_page("dvc", "params", "diff"))
    assert "mean_ratio_mean" in ran(
        committed, of_the_page("dvc", "metrics", "diff", holding="sphere")
    )
    assert "mean_ratio_mean" in ran(committed, of_the_page("dvc", "metrics", "show"))
    assert NAME in ran(committed, of_the_page("dvc", "exp", "show"))
    assert "geodesics.reward.form" in ran(committed, of_the_page("dvc", "exp", "diff"))
    ran(committed, of_the_page("dvc", "plots", "diff"))
    drawn = (committed / ".geodesics/curves/index.html").read_text()
    assert "thin: one seed; thick: the mean of the seeds" in drawn
    assert '"rev": "HEAD"' in drawn
    assert '"rev": "workspace"' in drawn
    ran(committed, of_the_page("git", "restore"))
    ran(committed, of_the_page("dvc", "checkout"))
    assert json.loads((committed / REPORT).read_text()) == before
    assert not ran(committed, [*of_the_page("git", "status"), "--porcelain"])
    ran(committed, of_the_page("dvc", "exp", "apply"))
    assert json.loads((committed / REPORT).read_text()) == after


def test_another_checkout_pulls_instead_of_repeating(committed: Path, tmp_path: Path) -> None:
    for undo in (of_the_page("git", "restore"), of_the_page("dvc", "checkout")):
        ran(committed, undo)
    add = of_the_page("dvc", "remote", "add")
    ran(committed, [str(tmp_path / "shared") if word.startswith("/srv/") else word for word in add])
    ran(committed, of_the_page("git", "commit"))
    ran(committed, of_the_page("dvc", "push"))
    theirs = tmp_path / "theirs"
    ran(committed, ["git", "clone", "--quiet", str(committed), str(theirs)])
    assert not (theirs / "data" / "analytic" / "plane").exists()
    stages = (STAGE, "digest_code")  # of the others nothing was run here
    ran(theirs, [*of_the_page("dvc", "pull"), *stages])
    assert "up to date" in ran(theirs, [*of_the_page("dvc", "status"), *stages])
    assert "Running stage" not in ran(theirs, ["dvc", "repro", STAGE])
    kept = Path("data") / "analytic" / "plane" / "curves.npz"
    assert (theirs / kept).read_bytes() == (committed / kept).read_bytes()
