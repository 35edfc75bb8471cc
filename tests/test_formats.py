"""Every file that people keep says its format; an older one is brought up to date, a newer one is
refused by one line that says who reads it.
"""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from constraint_geodesics import formats
from constraint_geodesics.bundle import CARD, card_digest, read_bundle
from constraint_geodesics.formats import RECORDING, SINCE, TABLE, Format, FormatError
from constraint_geodesics.geodesics import learned_method
from constraint_geodesics.geodesics.learned_method import FOLDER, read_learned
from constraint_geodesics.identification import load_constraint
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.recording import recording
from constraint_geodesics.scene.scene_file import read_attached, read_scene
from constraint_geodesics.trajectory import read_trajectory
from tests.planner_fixtures import packaged_planner
from tests.test_golden import RELEASES

NEWEST = RELEASES[-1]
LATER = "12.3.0"


def in_lines(text: str, number: int | None, since: str) -> str:
    """Of a CSV."""
    kept = [line for line in text.splitlines() if not line.startswith("# format")]
    said = [] if number is None else [f"# format: {number} (constraint_geodesics {since})"]
    return "\n".join([*said, *kept]) + "\n"


def in_entries(text: str, number: int | None, since: str) -> str:
    """Of YAML."""
    kept = [line for line in text.splitlines() if not re.match("(format|since):", line)]
    said = [] if number is None else [f"format: {number}", f"since: {since}"]
    return "\n".join([*said, *kept]) + "\n"


def in_card(text: str, number: int | None, since: str) -> str:
    """Of a planner's card, with its checksum."""
    card = {k: v for k, v in json.loads(text).items() if k not in ("format", "since")}
    card |= {} if number is None else {"format": number, "since": since}
    own = next(name for name in card["sha256"] if name.endswith(".json"))
    card["sha256"][own] = card_digest(card)
    return json.dumps(card)


def own_robot() -> Any:
    return packaged_planner().robot


Reader = Callable[[Path], object]
KINDS: dict[str, tuple[Format, Callable[..., str], Reader]] = {
    "path.csv": (formats.TABLE, in_lines, read_trajectory),
    "demonstrations.csv": (
        formats.TABLE,
        in_lines,
        lambda file: demonstrations_from(file, own_robot()),
    ),
    "scene.yaml": (formats.SCENE, in_entries, read_scene),
    "attached.yaml": (formats.SCENE, in_entries, read_attached),
    "constraint.yaml": (formats.CONSTRAINT, in_entries, load_constraint),
    f"planner/{CARD}": (formats.PLANNER, in_card, lambda file: read_bundle(file.parent)),
    f"planner/{FOLDER}/{learned_method.CARD}": (
        formats.LEARNED,
        in_card,
        lambda file: read_learned(file.parent),
    ),
}
every_kind = pytest.mark.parametrize("name", KINDS)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(NEWEST, tmp_path / "files"))


@every_kind
def test_what_is_written_says_its_format(name: str) -> None:
    form, _, _ = KINDS[name]
    text = (NEWEST / name).read_text()
    assert re.search(rf'^\W*format"?: {form.number}\b', text, re.M)
    if name in ("path.csv", "constraint.yaml") or name.endswith(
        ".json"
    ):  # which people don't write
        assert form.since in text


@every_kind
def test_a_newer_file_is_refused_and_says_who_reads_it(folder: Path, name: str) -> None:
    form, saying, read = KINDS[name]
    file = folder / name
    file.write_text(saying(file.read_text(), form.number + 1, LATER))
    with pytest.raises(ValueError, match=f"constraint_geodesics {LATER} reads it") as error:
        read(file)
    said = str(error.value)
    assert said.startswith(str(file))
    assert "\n" not in said
    assert said.endswith(f"this one reads up to format {form.number}")


@every_kind
def test_a_file_without_a_format_is_of_the_first(folder: Path, name: str) -> None:
    form, saying, read = KINDS[name]
    file = folder / name
    file.write_text(saying(file.read_text(), None, ""))
    if form.number == 1 or form.steps:
        read(file)
    else:
        with pytest.raises(ValueError, match="format 1: no release wrote it"):
            read(file)


@pytest.mark.parametrize("number", ["0", "-1", "1.5", "true", "null", "one", "[1]"])
def test_what_is_no_number_is_no_format(folder: Path, number: str) -> None:
    file = folder / "constraint.yaml"
    file.write_text(f"format: {number}\n{in_entries(file.read_text(), None, '')}")
    with pytest.raises(ValueError, match=r"constraint\.yaml: format .*: must be a whole number"):
        load_constraint(file)


def test_remarks_of_others_are_none(folder: Path) -> None:
    file = folder / "path.csv"
    file.write_text(f"# format: angles in rad\n{in_lines(file.read_text(), None, '')}")
    assert len(read_trajectory(file).joints) > 2


def test_a_shape_may_be_called_format(tmp_path: Path) -> None:
    (tmp_path / "cup.yaml").write_text(
        "format: {link: link6, kind: sphere, centre_m: [0, 0, 0.1], radius_m: 0.05}\n"
    )
    assert list(read_attached(tmp_path / "cup.yaml").attached) == ["format"]


def test_a_newer_recording_is_refused_and_one_without_a_format_read(monkeypatch, tmp_path) -> None:
    about, file = recording.About("planner", "free"), tmp_path / "path.rrd"

    def written(said: Format) -> Path:
        monkeypatch.setattr(recording, "RECORDING", said)
        recording.write_recording(file, "id", "name", [recording.about_chunk(about)])
        monkeypatch.setattr(recording, "RECORDING", RECORDING)
        return file

    stored, chunks, _ = recording.read_chunks(written(RECORDING))
    assert recording.about_of(stored.recording_id, chunks) == about
    with pytest.raises(
        recording.RecordingError, match="a later constraint_geodesics reads it; this one"
    ) as error:
        recording.read_chunks(written(Format(RECORDING.number + 1, LATER)))
    assert str(error.value).startswith(str(file))
    chunks = recording.text_chunks("from before recordings said so")
    recording.write_recording(file, "level_cup-query3-birrt-seed4", "", chunks)
    stored, chunks, _ = recording.read_chunks(file)
    assert recording.about_of(stored.recording_id, chunks).query == 3


# Steps from one format to the next


def renamed(content: dict[str, Any]) -> dict[str, Any]:
    return {"speed" if name == "velocity" else name: own for name, own in content.items()}


def doubled(content: dict[str, Any]) -> dict[str, Any]:
    return content | {"speed": 2 * content["speed"]}


THIRD = Format(3, "0.5.0", {1: renamed, 2: doubled})


@pytest.mark.parametrize(
    "content",
    [
        {"velocity": 1},
        {"format": 1, "velocity": 1},
        {"format": 2, "speed": 1},
        {"speed": 2} | THIRD.entries,
    ],
)
def test_an_older_file_takes_each_step_to_the_newest(content: dict[str, Any]) -> None:
    before = dict(content)
    assert THIRD.updated(content) == {"speed": 2}
    assert content == before


def test_a_format_before_the_first_step_is_refused() -> None:
    late = Format(3, "0.5.0", {2: doubled})
    assert late.updated({"format": 2, "speed": 1}) == {"speed": 2}
    with pytest.raises(FormatError, match="format 1: no release wrote it.* from format 2 on"):
        late.updated({"velocity": 1})


@pytest.mark.parametrize("since", [None, 5, "a b", "x" * 200, ["1.0"]])
def test_what_is_no_release_is_not_told(since: object) -> None:
    with pytest.raises(FormatError, match="a later constraint_geodesics reads it"):
        TABLE.updated({"format": 7, SINCE: since})


def test_the_page_lists_every_format() -> None:
    """docs/files.md, by the names of formats.py."""
    page = (NEWEST.parents[2] / "docs" / "files.md").read_text()
    found = {name: own for name, own in vars(formats).items() if isinstance(own, Format)}
    told = {
        name: int(number) for number, name in re.findall(r"\| (\d+) \| `(\w+)` \|$", page, re.M)
    }
    assert told == {name: own.number for name, own in found.items()}
