"""What every page of the report promises, whatever is on it, and its tables as texts."""

import html.parser
import re
from pathlib import Path

DASHBOARD = "http://127.0.0.1:5000/#/"


class Page(html.parser.HTMLParser):
    """Reads a page and checks that every element is closed where it was opened.

    tables: by the name of their region, rows of texts, the header first.  checked: name and value
    of each box that is ticked when the page is opened.
    """

    VOID = frozenset({"meta", "img", "br", "input"})
    NAMED = re.compile(r"--(family-\w+): (#[0-9A-Fa-f]{6});")

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.sources, self.ids, self.alts = [], [], [], [], []
        self.headings, self.scopes, self.tables, self.colours = [], [], {}, {}
        self.commands, self.region, self.text, self.checked = set(), "", None, []
        self.by_name = dict(reversed(self.NAMED.findall(text)))  # the first are those by day
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if "href" in attrs:
            assert tag == "a", f"{tag} would load {attrs['href']}"
            self.links.append(attrs["href"])
        self.sources += [attrs["src"]] if "src" in attrs else []
        self.ids += [attrs["id"]] if "id" in attrs else []
        self.alts += [attrs["alt"]] if tag == "img" else []
        self.headings += [int(tag[1])] if re.fullmatch(r"h[1-6]", tag) else []
        self.region = (
            attrs.get("aria-label", self.region) if attrs.get("role") == "region" else self.region
        )
        if tag == "table":
            assert self.region not in self.tables, f"two tables are called {self.region}"
            self.tables[self.region] = []
        elif tag == "tr":
            self.tables[self.region].append([])
        elif tag in ("th", "td", "code"):
            self.text = ""
            self.scopes += [attrs.get("scope")] if tag == "th" else []
        elif tag == "i" and self.text is not None:
            colours = self.colours.setdefault(self.region, {})
            name = re.fullmatch(r"background:var\(--(.*)\)", attrs["style"])[1]
            colours[len(self.tables[self.region]) - 1] = self.by_name[name]
        if "checked" in attrs:
            self.checked.append((attrs.get("name"), attrs.get("value")))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_data(self, data):
        if self.text is not None:
            self.text += data

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag in ("th", "td"):
            self.tables[self.region][-1].append(self.text)
        elif tag == "code":
            self.commands.add(self.text)
        if tag in ("th", "td", "code"):
            self.text = None

    def rows(self, title):
        """A table's rows after its header, by their first text."""
        return {row[0]: row[1:] for row in self.tables[title] if len(row) > 1}


def check_page(text: str, folder: Path, elsewhere: tuple[str, ...] = ()) -> Page:
    """Opening it loads nothing; what it links to is there; it is in order for who does not see it.

    folder: where it lies.  elsewhere: files it links to that need not be there.
    """
    page = Page(text)
    assert all(
        re.fullmatch(r"data:image/png;base64,[A-Za-z0-9+/=]+", source) for source in page.sources
    )
    own = re.sub(r'(src="data:image/png;base64,|href=")[^"]*"', "", text)
    assert not re.search(
        r"https?:|//[a-z]|@import|url\((?!#)|<link|<script [^>]|fetch\(|XMLHttp", own
    )
    assert "default-src 'none'" in own
    for link in page.links:
        file, _, anchor = link.partition("#")
        if not file:
            assert anchor in page.ids, link
        elif not link.startswith(DASHBOARD):
            assert file in elsewhere or (folder / file).is_file(), link
    assert len(set(page.ids)) == len(page.ids)
    assert page.headings.count(1) == 1
    assert all(
        after - before <= 1
        for before, after in zip([0, *page.headings], page.headings, strict=False)
    )
    assert len(page.alts) == len(set(page.alts))
    assert all(len(alt) > 10 for alt in page.alts)
    assert None not in page.scopes
    assert len(text.encode()) < 1_200_000
    return page
