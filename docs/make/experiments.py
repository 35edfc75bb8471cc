"""Run the experiments of docs/experiments.md as the page says, and write what is printed below its
markers.

The commands are the page's own: those of the shell's blocks in each section that has a marker `<!--
output: NAME -->`.  They run in a clone of the last commit, which shares this checkout's DVC cache
and MLflow store, so this checkout stays as it is.  What was run before on the same sources and
parameters is not run again.

    python docs/make/experiments.py [NAME ...]      the sections of these markers; by default all
"""

import argparse
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "experiments.md"
FOLDER = ROOT / ".geodesics" / "experiments"
CLONE = FOLDER / "checkout"
MARKER = re.compile(
    r"<!-- output: (\w+) -->\n(?:(?:(?!<!-- output: ).)*?<!-- /output -->\n)?", re.S
)
"""A marker, and the output below it if there is one; that of a later marker is not its own."""
SOURCES = ("src", "stages", "params.yaml", "dvc.yaml", "dvc.lock")
"""What an experiment's result depends on, in the last commit."""
UNDONE = (
    "git reset --quiet --hard",
    "git clean --quiet --force -d",
    "dvc checkout --quiet --allow-missing",
)


@dataclass(frozen=True)
class Section:
    """What one section of the page runs, and the marker that its last block's output stands
    below.
    """

    name: str
    commands: tuple[str, ...]
    shown: tuple[str, ...]

    def key(self, sources: str) -> str:
        """Changes with the commands and with what they run on."""
        return hashlib.sha256(
            "\n".join([sources, *self.commands, *self.shown]).encode()
        ).hexdigest()[:16]


def sections(page: str) -> list[Section]:
    """The sections that have a marker, in order; the plots of a block are pages and print nothing
    to show.
    """
    found = []
    for text in re.split(r"^## ", page, flags=re.M)[1:]:
        marker = MARKER.search(text)
        if marker:
            blocks = [
                lines_of(block)
                for block in re.findall(r"^```bash\n(.*?)^```", text[: marker.start()], re.S | re.M)
            ]
            shown = tuple(
                line for line in blocks[-1] if not line.startswith(("dvc plots", "make "))
            )
            runs = tuple(
                line for block in blocks for line in block if line.startswith("dvc exp run")
            )
            found.append(Section(marker.group(1), runs, shown))
    return found


def lines_of(block: str) -> list[str]:
    """The commands of a shell's block, each on one line."""
    return [
        line
        for line in block.replace("\\\n", " ").splitlines()
        if line and not line.startswith("#")
    ]


def prepare() -> str:
    """Bring the clone to the last commit; returns a name of what experiments depend on there.

    Where that has not changed the clone stays where it is: DVC lists experiments by the commit they
    started from.
    """
    if not (CLONE / ".git").is_dir():
        FOLDER.mkdir(parents=True, exist_ok=True)
        said(["git", "clone", "--quiet", str(ROOT), str(CLONE)], ROOT)
        said(["dvc", "cache", "dir", "--local", str(ROOT / ".dvc" / "cache")], CLONE)
        for key, value in (("user.name", "experiments"), ("user.email", "experiments@localhost")):
            said(["git", "config", key, value], CLONE)
    wanted = sources_of(ROOT)
    if sources_of(CLONE) != wanted:
        commit = said(["git", "rev-parse", "HEAD"], ROOT).strip()
        said(["git", "fetch", "--quiet", "origin", commit], CLONE)
        said(["git", "checkout", "--quiet", "--force", "--detach", commit], CLONE)
    take_compiled_kernels()
    return wanted


def sources_of(checkout: Path) -> str:
    """The contents of what experiments depend on, in the last commit."""
    return said(["git", "rev-parse", *(f"HEAD:{name}" for name in SOURCES)], checkout)


def take_compiled_kernels() -> None:
    """A folder of kernels is named by the contents of their sources: where they agree, this
    checkout's are used.
    """
    for folder in (ROOT / "src").rglob("kernels-*"):
        shutil.copytree(folder, CLONE / folder.relative_to(ROOT), dirs_exist_ok=True)


def run(section: Section) -> dict[str, str]:
    """Run a section from the commit's state; what its last block prints, by command, and how long
    it ran.
    """
    for command in UNDONE if section.commands else ():
        said(shlex.split(command), CLONE)
    began, trained = time.monotonic(), False
    for command in section.commands:
        print(f"$ {command}", file=sys.stderr, flush=True)
        forget(command)
        trained |= "Running stage" in said(shlex.split(command), CLONE)
    took = time.monotonic() - began
    printed = {command: said(shlex.split(command), CLONE).rstrip() for command in section.shown}
    if silent := [command for command, text in printed.items() if not text]:
        raise SystemExit(f"error: it prints nothing: {silent[0]}")
    return printed | ({"took": f"{took:.0f}"} if trained else {})


def forget(command: str) -> None:
    """An experiment of an earlier time under the same name, if there is one."""
    words = shlex.split(command)
    name = words[words.index("-n") + 1]
    subprocess.run(
        ["dvc", "exp", "remove", name],
        cwd=CLONE,
        env=environment(),
        capture_output=True,
        check=False,
    )


def said(command: list[str], folder: Path) -> str:
    """What a command prints.  Raises SystemExit with its last words if it fails."""
    done = subprocess.run(
        command, cwd=folder, env=environment(), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(
            f"error: {shlex.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        )
    return done.stdout


def environment() -> dict[str, str]:
    """The clone's own source, this checkout's store, a table as wide as it is."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    store = os.environ.get("MLFLOW_TRACKING_URI", f"sqlite:///{ROOT / 'mlflow.db'}")
    return os.environ | {
        "PYTHONPATH": str(CLONE / "src"),
        "PATH": path,
        "MLFLOW_TRACKING_URI": store,
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "160",
        "NO_COLOR": "1",
    }


def filled(page: str, outputs: dict[str, dict[str, str]]) -> str:
    """The page with each marker's output below it; a marker without one stays as it is."""

    def below(found: re.Match[str]) -> str:
        if found.group(1) not in outputs:
            return found.group(0)
        printed = dict(outputs[found.group(1)])
        took = printed.pop("took", None)
        tables = [f"```text\n{text}\n```\n" for text in printed.values() if text]
        time_taken = [f"`dvc exp run` took {took} s on {os.cpu_count()} cores.\n"] if took else []
        return "\n".join(
            [f"<!-- output: {found.group(1)} -->\n", *tables, *time_taken, "<!-- /output -->\n"]
        )

    return MARKER.sub(below, page)


def main(wanted: list[str]) -> None:
    """Run the sections that are not done, one after another, and write the page after each."""
    todo = [
        section for section in sections(PAGE.read_text()) if not wanted or section.name in wanted
    ]
    unknown = set(wanted) - {section.name for section in todo}
    if unknown:
        raise SystemExit(f"error: {PAGE.name} has no marker {', '.join(sorted(unknown))}")
    sources = prepare()
    for section in todo:
        record = FOLDER / f"{section.name}-{section.key(sources)}.json"
        if not record.is_file() or not section.commands:
            record.write_text(json.dumps(run(section), indent=1))
        PAGE.write_text(filled(PAGE.read_text(), {section.name: json.loads(record.read_text())}))
        print(f"{section.name}: written to {PAGE.relative_to(ROOT)}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="markers of docs/experiments.md; by default all"
    )
    main(parser.parse_args().names)
