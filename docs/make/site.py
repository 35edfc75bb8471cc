"""MkDocs calls this: the notebook becomes a page, and a file of the site that would load something
from the net is an error.
"""

import base64
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

NOTEBOOK = "first_path.ipynb"
PAGE = "first_path_notebook.md"
OUTSIDE = "checkout:"
"""Before a link's file that is not of the site, in place of a path that MkDocs would look for."""
LOADING = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "link": "href",
    "object": "data",
}
"""Elements that a browser loads something for, and the attribute that says what."""


def on_files(files: Any, config: Any) -> Any:
    """Add the notebook as a page, with the outputs that are stored in it."""
    notebook = json.loads((Path(config["docs_dir"]) / NOTEBOOK).read_text())
    files.append(File.generated(config, PAGE, content=as_markdown(notebook)))
    return files


def on_page_markdown(markdown: str, config: Any, **_: Any) -> str:
    """Links to the notebook lead to its page; pictures of reports are data inside the page, and
    links to reports lead out of the site.
    """
    reports = Path(config["docs_dir"]).parent

    def embedded(found: re.Match[str]) -> str:
        picture = base64.b64encode((reports / found[1]).read_bytes()).decode()
        return f"](data:image/png;base64,{picture})"

    linked = re.sub(r"\]\(\.\./(reports/[^)]+\.png)\)", embedded, markdown)
    outside = re.sub(r"\]\(\.\./(reports/[^)]+)\)", rf"]({OUTSIDE}\1)", linked)
    return outside.replace(f"({NOTEBOOK})", f"({PAGE})")


def on_page_content(html: str, config: Any, **_: Any) -> str:
    """Links to reports lead to those of the checkout that the site lies in."""
    site, checkout = Path(config["site_dir"]), Path(config["docs_dir"]).parent
    return html.replace(f'href="{OUTSIDE}', f'href="{os.path.relpath(checkout, site)}/')


def on_post_build(config: Any) -> None:
    """Raise PluginError, which fails the build, for the first thing that would come from the
    net.
    """
    for file in sorted(Path(config["site_dir"]).rglob("*")):
        if file.suffix in (".html", ".css", ".js"):
            for address in loaded_from_the_net(file.read_text(), file.suffix):
                raise PluginError(f"{file}: would load {address}")


def as_markdown(notebook: dict[str, Any]) -> str:
    """Text as it is; code and what it printed in fences; pictures as data inside the page."""
    return "\n\n".join(part for cell in notebook["cells"] for part in _cell(cell))


def _cell(cell: dict[str, Any]) -> list[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [source]
    return [f"```python\n{source}\n```", *(_output(output) for output in cell["outputs"])]


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        return f"![output](data:image/png;base64,{''.join(data['image/png'].split())})"
    return f"```text\n{''.join(output.get('text', data.get('text/plain', ''))).rstrip()}\n```"


def loaded_from_the_net(text: str, suffix: str) -> list[str]:
    """Addresses of another machine that a browser would open for this file, without a click."""
    if suffix == ".html":
        found = _Loaded()
        found.feed(text)
        return found.addresses + _styles(text)
    if suffix == ".css":
        return _styles(text)
    return re.findall(r"""(?:fetch|import|importScripts)\(\s*["'](?:https?:)?//[^"']+""", text)


def _styles(text: str) -> list[str]:
    return re.findall(r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"')]+)""", text)


class _Loaded(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        address = dict(attrs).get(LOADING.get(tag, "")) or ""
        if re.match(r"(?:https?:)?//", address):
            self.addresses.append(address)
