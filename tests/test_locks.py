"""What may be installed: locked versions with the hashes of their files, and nothing else."""

import importlib
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
HASHED = (
    *("requirements.hashes", "docs/requirements.lock", "tests/browser/requirements.lock"),
    *("tests/faults/requirements.lock", ".ci/requirements.lock"),
)
_ENTRY = re.compile(r"^([\w.-]+)==(\S+) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", re.M)


def script(name: str) -> ModuleType:
    """One of .ci/, which is no package; they import each other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / ".ci")
        return importlib.import_module(name)


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def entries(file: str) -> dict[str, str]:
    return {normal(name): version for name, version, _ in _ENTRY.findall((ROOT / file).read_text())}


def test_every_locked_version_has_hashes() -> None:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    versions = {normal(name): version for name, version in (line.split("==") for line in lines)}
    hashed = entries("requirements.hashes")
    assert {name: hashed.get(name) for name in versions} == versions
    assert set(hashed) - set(versions) == {"setuptools"}, "which builds what has no wheel"


@pytest.mark.parametrize("file", HASHED)
def test_a_lock_holds_hashed_pins_and_no_address(file: str) -> None:
    text = (ROOT / file).read_text()
    rest = _ENTRY.sub("", text)
    assert all(line.startswith("#") for line in rest.splitlines()), "a pin without hashes"
    assert not re.search(r"://|--(extra-)?index|--find-links|--trusted", text)
    assert len(entries(file)) >= 2


def test_planning_s_part_is_what_planning_needs() -> None:
    lock = script("lock")
    first, _, _ = (ROOT / "requirements.hashes").read_text().partition(lock.REST)
    found = {normal(name) for name, _, _ in _ENTRY.findall(first)}
    assert found == lock.needed_for(lock.PLANNING) - {"constraint-geodesics"}
    assert lock.REST.startswith("# What the pipeline"), "as the Makefile looks for it"


def test_all_that_is_installed_is_hashed() -> None:
    """But for this project itself, and what torch's build for graphics cards pins."""
    makefile = (ROOT / "Makefile").read_text()
    assert "--require-hashes" in re.findall(r"^HASHED := (.*)$", makefile, re.M)[0]
    others = [line.strip() for line in makefile.splitlines() if "$(INSTALL)" in line]
    assert others[1:] == [
        ".venv/bin/python $(INSTALL) --no-deps --no-build-isolation --editable .",
        "@.venv/bin/python -m pip check > /dev/null || .venv/bin/python $(INSTALL) torch",
    ]
    assert "pip install" not in makefile.replace("-m pip install --quiet", "", 1)


def test_an_audit_fails_on_a_finding_alone_and_says_what_it_could_not_ask() -> None:
    verdict = script("audit").verdict
    safe = {"name": "a", "version": "1", "vulns": []}
    unasked = {"name": "b", "skip_reason": "no such package there"}
    fault = {"id": "PYSEC-1", "fix_versions": ["2"]}
    assert verdict([safe]) == (["1 of 1 locked packages were asked about, 0 findings"], 0)
    lines, code = verdict([safe, unasked])
    assert code == 0
    assert lines[0].startswith("1 of 2")
    assert "nothing is known of the other 1" in lines[1]
    lines, code = verdict([{**safe, "vulns": [fault]}, unasked])
    assert code == 1
    assert lines[0] == "a 1: PYSEC-1, mended in 2"
