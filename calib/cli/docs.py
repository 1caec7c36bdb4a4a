"""`calib docs`: the manual, rendered from the Markdown that ships with the package, without a network."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import JsonOption, answer, emit, narrate
from calib.core import __version__
from calib.core.errors import BadInputError, UsageError
from calib.core.words import nearest
from calib.core.writing import Kind, holds

if TYPE_CHECKING:
    from markdown_it import MarkdownIt
    from markdown_it.token import Token

MANUAL = Path(__file__).resolve().parent.parent / "docs"
INDEX = "index"
GROUPS = {"howto": "How to", "reference": "Reference"}
"""Folders of the manual and their titles beside the pages."""


@dataclass(frozen=True)
class Page:
    """A page of the manual: its path below the manual without ending, its title, its Markdown."""

    name: str
    title: str
    text: str

    @property
    def topic(self) -> str:
        """The last part of the name, which no other page shares."""
        return self.name.rsplit("/", 1)[-1]


def docs(
    topic: Annotated[str, typer.Argument(help="Page to open, such as tutorial; --list names all.")] = INDEX,
    list_topics: Annotated[bool, typer.Option("--list", help="List the pages and leave.")] = False,
    print_page: Annotated[
        bool, typer.Option("--print", help="Print the page's Markdown instead of opening it.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="Folder to write the HTML pages into. [default: the user's cache]"
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Open the manual in the browser, offline.

    Where no browser can be opened, it prints the path of the page.
    """
    pages = manual()
    page = page_of(topic, pages)
    if print_page:
        emit(page.text)
        return
    topics = {one.topic: one.title for one in pages}
    if list_topics:
        lines = (f"  {name:<16}{title}" for name, title in topics.items())
        answer(as_json, "docs", {"docs": {"topics": topics}}, *lines)
        return
    folder = write_manual(pages, _cache() if output is None else output)
    path = folder / f"{page.name}.html"
    answer(as_json, "docs", {"docs": {"page": str(path), "topics": topics}}, str(path))
    if output is None and not as_json and not _opened(path):
        narrate("no browser could be opened; open this file in one")


def manual() -> list[Page]:
    """All pages, in the order in which the index links them."""
    index = (MANUAL / f"{INDEX}.md").read_text(encoding="utf-8")
    names = dict.fromkeys([INDEX, *re.findall(r"\]\(([\w/-]+)\.md\)", index)])
    pages = []
    for name in names:
        text = (MANUAL / f"{name}.md").read_text(encoding="utf-8")
        pages.append(Page(name, text.split("\n", 1)[0].removeprefix("# "), text))
    return pages


def page_of(topic: str, pages: list[Page]) -> Page:
    """The page of a topic. Raises `UsageError` with the nearest topic where there is none."""
    wanted = topic.removesuffix(".md")
    for page in pages:
        if wanted in (page.topic, page.name):
            return page
    hint = nearest(wanted, [page.topic for page in pages]) or "; calib docs --list names all"
    raise UsageError(f"the manual has no page {topic[:60]!r}{hint}")


PAGE = Kind("a page of the manual", (".html",), holds(b" - calib</title>"))


def write_manual(pages: list[Page], folder: Path) -> Path:
    """Write all pages as HTML into a folder and return its absolute path."""
    import jinja2
    from markupsafe import Markup

    from calib.core.writing import make_folder, write_atomically

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    template = environment.from_string((MANUAL / "page.html.j2").read_text(encoding="utf-8"))
    markdown = _markdown()
    folder = folder.absolute()
    for page in pages:
        path = folder / f"{page.name}.html"
        depth = "../" * (len(PurePosixPath(page.name).parts) - 1)
        groups: list[dict[str, Any]] = []
        for one in pages:
            group = GROUPS.get(one.name.rpartition("/")[0], "About" if groups[1:] else "")
            if not groups or groups[-1]["name"] != group:
                groups.append({"name": group, "entries": []})
            link = f"{depth}{one.name}.html"
            groups[-1]["entries"].append({"link": link, "title": one.title, "current": one is page})
        # The Markdown is the package's own, and HTML inside it is escaped.
        body = Markup(markdown.render(page.text))
        make_folder(path.parent)
        text = template.render(title=page.title, version=__version__, groups=groups, body=body)
        write_atomically(path, text, PAGE)
    return folder


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub forms it."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _markdown() -> MarkdownIt:
    """Markdown with tables; headings get anchors, links to pages lead to their HTML."""
    from markdown_it import MarkdownIt

    made = MarkdownIt("commonmark", {"html": False}).enable("table")

    def finish(tokens: list[Token]) -> None:
        for token, inner in zip(tokens, [*tokens[1:], None], strict=True):
            if token.type == "heading_open" and inner is not None:
                token.attrSet("id", slug(inner.content))
            for child in token.children or []:
                if child.type == "link_open":
                    target = str(child.attrGet("href") or "")
                    if "://" not in target:
                        child.attrSet("href", re.sub(r"\.md(?=#|$)", ".html", target))

    made.core.ruler.push("manual", lambda state: finish(state.tokens))
    made.add_render_rule("table_open", lambda *_: '<div class="wide"><table>\n')
    made.add_render_rule("table_close", lambda *_: "</table></div>\n")
    return made


def _cache() -> Path:
    """The user's cache, since the pages outlive the command; a temporary folder if it cannot be written."""
    import tempfile

    from calib.core.writing import make_folder

    system = {"win32": os.environ.get("LOCALAPPDATA"), "darwin": "~/Library/Caches"}
    base = system.get(sys.platform) or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    folder = Path(base).expanduser() / "calib" / f"manual-{__version__}"
    try:
        make_folder(folder)
        if os.access(folder, os.W_OK):
            return folder
    except BadInputError:
        pass
    return Path(tempfile.mkdtemp(prefix="calib-manual-"))


def _opened(path: Path) -> bool:
    """Whether a browser was opened. Without a display none is: one in the terminal would take it over."""
    import webbrowser

    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return False
    return webbrowser.open(path.as_uri())
