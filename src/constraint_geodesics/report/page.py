"""Pages that open offline: one look for all, figures embedded, nothing asked of the network."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from constraint_geodesics.palette import FAMILIES
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.blocks import Block
from constraint_geodesics.report.results import ReportError


@dataclass(frozen=True)
class Picture:
    """A figure on a page.  file: the PNG, somewhere below the page's folder.  alt: what is said
    where it isn't seen.
    """

    name: str
    title: str
    caption: str
    alt: str
    file: Path


@dataclass(frozen=True)
class Section:
    """A part of a page: its anchor and title, what comes first, its figures, and tables, some of
    them folded.
    """

    name: str
    title: str
    text: str
    pictures: Sequence[Picture] = ()
    blocks: Sequence[Block] = ()
    folded: Sequence[Block] = ()


def write_page(layout: Layout, name: str, **content: Any) -> Path:
    """Write reports/<name>.html from its template; returns the file.

    Raises ReportError naming the figure that is missing.
    """
    file = layout.root / "reports" / f"{name}.html"
    environment = Environment(
        loader=PackageLoader("constraint_geodesics.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["png"] = _embedded
    environment.filters["size"] = _size
    environment.filters["link"] = lambda target: target.relative_to(file.parent).as_posix()
    page = environment.get_template(f"{name}.html.j2").render(content, families=FAMILIES.values())
    file.write_text(page, encoding="utf-8")
    return file


def _size(file: Path) -> str:
    """Width and height as attributes, so that nothing moves while the page is opened."""
    with Image.open(file) as image:
        return f"width={image.width} height={image.height}"


def _embedded(file: Path) -> str:
    try:
        return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"
    except FileNotFoundError:
        raise ReportError(f"{file}: missing; `make repro` and `make bench` make it") from None
