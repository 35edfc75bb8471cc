"""XML that others wrote (URDF, SRDF, Collada), read without what makes XML dangerous: entities,
which may name files and addresses or grow without end, and depth without end.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from constraint_geodesics.text_files import read_content

DEEPEST = 200
"""Elements within each other: a robot has ten."""


class XmlFileError(ValueError):
    """A file is no XML that is read; the message says why, and not which file it is."""


def read_xml(file: Path) -> Element:
    """The root element of a file.

    Raises XmlFileError, one line, for one that is no XML, declares a document type, without which
    there are no entities, or is nested deeper than DEEPEST; OSError for one that can't be read.
    """
    parser = XMLParser(target=_Plain())
    try:
        parser.feed(read_content(file))
        root: Element = parser.close()
    except XmlFileError:
        raise
    except (ParseError, LookupError, ValueError) as error:
        raise XmlFileError(" ".join(str(error).split())) from None
    return root


class _Plain(TreeBuilder):
    """Elements alone."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Called where a document type begins, before any of its entities are declared."""
        raise XmlFileError("it declares a document type, which is not read: remove <!DOCTYPE …>")

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        """An element begins."""
        self._depth += 1
        if self._depth > DEEPEST:
            raise XmlFileError(f"its elements are nested deeper than {DEEPEST}")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        """An element ends."""
        self._depth -= 1
        return super().end(tag)
