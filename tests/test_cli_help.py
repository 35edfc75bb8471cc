"""What `geodesics` says of itself: its version, and help texts as they are written."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from constraint_geodesics import cli
from tests.test_cli_plan import called

ROOT = Path(__file__).resolve().parents[1]
PROGRAM: Any = typer.main.get_command(cli.app)


def test_the_version_is_that_of_the_package(monkeypatch, capfd) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    line = f"{project['name']} {project['version']}\n"
    assert called(monkeypatch, capfd, ["--version"]) == (0, line, "")


def texts(command: Any) -> Iterator[str]:
    """What a command's help must hold."""
    yield command.help
    yield from (own.help for own in command.params if own.help)


@pytest.mark.parametrize("name", [None, *PROGRAM.commands])
def test_help_is_printed_as_it_is_written(name, monkeypatch, capfd) -> None:
    """Brackets too, which markup would take for its own."""
    command = PROGRAM.commands[name] if name else PROGRAM
    for own in command.params:
        if own.help:
            monkeypatch.setattr(own, "help", f"{own.help} [rad], [m/s] and [bold]")
    monkeypatch.setattr(typer.main, "get_command", lambda _: PROGRAM)
    code, out, _ = called(monkeypatch, capfd, [*([name] if name else []), "--help"])
    assert code == 0
    shown = re.sub(r"\s+", "", out)
    for text in texts(command):
        assert re.sub(r"\s+", "", text) in shown
