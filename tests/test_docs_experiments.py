"""The script that fills the outputs of docs/experiments.md takes its commands from the page, and
changes no more.
"""

import importlib.util
import re
import sys

import pytest

from tests.test_docs import PAGES, ROOT

SCRIPT = ROOT / "docs" / "make" / "experiments.py"
PAGE = PAGES["experiments.md"]


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("docs_experiments", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_every_marker_of_the_page_has_its_commands(script) -> None:
    sections = {section.name: section for section in script.sections(PAGE)}
    assert list(sections) == re.findall(r"<!-- output: (\w+) -->", PAGE)
    for name, section in sections.items():
        assert section.shown, name
        assert all(command in PAGE for command in (*section.commands, *section.shown)), name
        assert all(command.startswith("dvc exp run -n ") for command in section.commands), name
        assert not any(command.startswith(("make", "dvc plots")) for command in section.shown), name
    assert len(sections["reward_metrics_diff"].commands) == 2
    assert sections["exp_show"].commands == ()


def test_every_marker_of_the_page_has_its_output() -> None:
    for name, below in re.findall(r"<!-- output: (\w+) -->\n(.*?)(?=<!-- output|\Z)", PAGE, re.S):
        assert re.match(r"\n```text\n\S", below), name


def test_a_record_is_of_the_commands_and_of_what_they_run_on(script) -> None:
    section, other = script.sections(PAGE)[:2]
    assert len({section.key("a"), section.key("b"), other.key("a")}) == 3
    assert section.key("a") == script.sections(PAGE)[0].key("a")


TEXT = """before

<!-- output: first -->

- said

<!-- output: second -->

```text
old
```

<!-- /output -->

after
"""


def test_an_output_is_put_below_its_own_marker(script) -> None:
    once = script.filled(TEXT, {"first": {"dvc x": "table", "dvc y": "", "took": "61"}})
    assert once == TEXT.replace(
        "<!-- output: first -->\n",
        "<!-- output: first -->\n\n```text\ntable\n```\n\n`dvc exp run` took 61 s on "
        f"{script.os.cpu_count()} cores.\n\n<!-- /output -->\n",
    )
    twice = script.filled(once, {"second": {"dvc x": "new"}})
    assert twice == once.replace("old", "new")
    assert script.filled(twice, {"second": {"dvc x": "new"}}) == twice
    assert script.filled(TEXT, {}) == TEXT
