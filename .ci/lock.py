"""Which files of the locked versions may be installed: their hashes, as the package index has them.

requirements.lock says versions, which results hang on, and names no files; requirements.hashes has
the SHA-256 of every file that the index has of each, for all platforms, those of `make plan` first.
The other lock files hold their hashes themselves.  `make lock` renews all of them after a change of
versions, with the pip-compile of the Python that it is given, and whatever index pip is configured
with, whose address is kept nowhere.
"""

import os
import re
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
VERSIONS, HASHES = ROOT / "requirements.lock", ROOT / "requirements.hashes"
OTHERS = (
    *("docs/requirements.lock", "tests/browser/requirements.lock"),
    *("tests/faults/requirements.lock", ".ci/requirements.lock"),
)
PLANNING = "constraint-geodesics[record]"
ABOVE = (
    "# What planning needs: `make plan`.  `make lock` writes this file; versions are those of",
    "# requirements.lock, and a test compares them.",
)
REST = "# What the pipeline, the benchmark and the tests need besides: `make env`."
"""The line that `make plan` reads up to."""
_PIN = re.compile(r"^([A-Za-z0-9._-]+)==(\S+)", re.MULTILINE)


def main() -> None:
    """Write all of them."""
    entries = hashed(VERSIONS.read_text())
    planning = needed_for(PLANNING)
    parts = [
        *ABOVE,
        *(text for name, text in entries.items() if name in planning),
        REST,
        *(text for name, text in entries.items() if name not in planning),
    ]
    HASHES.write_text("\n".join(parts) + "\n")
    for file in OTHERS:
        text = (ROOT / file).read_text()
        above = [line for line in text.splitlines() if line.startswith("#")]
        pins = _PIN.findall(text)
        found = hashed("\n".join("==".join(pin) for pin in pins))
        # what they need besides is of another file
        kept = [found[name] for name in sorted(_normal(name) for name, _ in pins)]
        (ROOT / file).write_text("\n".join([*above, *kept]) + "\n")


def hashed(pins: str) -> dict[str, str]:
    """Each pin's lines in a lock file, by the package's name.  A version of which this machine has
    a build of its own, as of torch for processors alone, has the index's builds too.
    """
    found = _compiled(pins)
    own = [text for text in found.values() if "+" in text.splitlines()[0]]
    if own:
        names = {_name(text): text for text in own}
        public = _compiled("\n".join(_pin(text).partition("+")[0] for text in own), alone=True)
        for name in names:
            lines = {*names[name].splitlines()[1:], *public[name].splitlines()[1:]}
            sums = sorted(line.rstrip(" \\") for line in lines)
            found[name] = " \\\n".join([_pin(public[name]), *sums])
    return found


def _compiled(pins: str, *, alone: bool = False) -> dict[str, str]:
    """alone: from the index, and from no folder of files."""
    with tempfile.TemporaryDirectory() as folder:
        given, out, empty = (Path(folder) / name for name in ("in", "out", "empty"))
        given.write_text(pins + "\n")
        empty.mkdir()
        quiet = ["annotate", "header", "emit-options"]
        command = [sys.argv[1], "-m", "piptools", "compile", "--generate-hashes", "--quiet"]
        command += [*(f"--no-{word}" for word in quiet), "--strip-extras", "--allow-unsafe"]
        environment = {**os.environ, **({"PIP_FIND_LINKS": str(empty)} if alone else {})}
        asked = [*command, "--output-file", str(out), str(given)]
        subprocess.run(asked, check=True, env=environment, stderr=subprocess.DEVNULL)
        entries = re.split(r"\n(?=[A-Za-z0-9])", out.read_text())
    kept = ["\n".join(own.split("\n#")[0].rstrip().splitlines()) for own in entries]
    return {_name(own): own for own in kept if _PIN.match(own)}


def needed_for(requirement: str) -> set[str]:
    """Names of all packages that one needs, as they are installed in the project's environment."""
    found, waiting = set[tuple[str, frozenset[str]]](), [requirement]
    while waiting:
        own = Requirement(waiting.pop())
        key = _normal(own.name), frozenset(own.extras)
        if key in found:
            continue
        found.add(key)
        for text in metadata.requires(own.name) or ():
            other = Requirement(text)
            extras = ({"extra": extra} for extra in (*own.extras, ""))
            if other.marker is None or any(other.marker.evaluate(extra) for extra in extras):
                waiting.append(text.partition(";")[0])
    return {name for name, _ in found} | {"setuptools"}


def _pin(entry: str) -> str:
    return entry.splitlines()[0].rstrip(" \\")


def _name(entry: str) -> str:
    return _normal(entry.partition("==")[0])


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    main()
