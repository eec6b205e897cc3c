"""The parts of a page that is one file: no script, nothing from a network, for light and dark, wide and narrow.

Text is escaped wherever it is put into an element; only `Html`, which these functions return, is taken as it is. So
nothing that stands in a run's files can become markup.
"""

import base64
import os
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from lemniscate.system.files import replace_file

MOST_BYTES = 5_000_000
"""the largest film that is embedded; a larger one is linked"""

KINDS = {".png": "image/png", ".gif": "image/gif", ".webp": "image/webp", ".mp4": "video/mp4"}

WITHOUT_END = ("img", "meta")

STYLE = """
:root { color-scheme: light dark; --ink: #1c2128; --soft: #5b6572; --page: #ffffff; --card: #f4f6f8; --line: #d9dee4;
  --accent: #1f5fa8; --mark: #fff3d6; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e7eb; --soft: #9aa5b1; --page: #111417; --card: #1a1f24;
  --line: #323a43; --accent: #7db4f0; --mark: #3b3114; } }
body { margin: 0 auto; padding: 1.5rem 1rem 3rem; max-width: 60rem; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { margin: 0; font-size: 1.7rem; line-height: 1.2; }
h2 { margin: 2.2rem 0 0.6rem; padding-bottom: 0.25rem; border-bottom: 1px solid var(--line); font-size: 1.2rem; }
h3 { margin: 1.4rem 0 0.4rem; font-size: 1rem; }
a { color: var(--accent); }
.soft, figcaption, footer { color: var(--soft); font-size: 0.9rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: 0.75rem; margin: 1.2rem 0; }
.cards div { padding: 0.7rem 0.9rem; border-radius: 0.5rem; background: var(--card); }
.cards strong { display: block; font-size: 1.3rem; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; overflow-wrap: normal; font-size: 0.92rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 1.4rem 0.3rem 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
th { color: var(--soft); font-weight: 600; }
td { min-width: 4rem; }
mark { padding: 0 0.3em; border-radius: 0.25em; background: var(--mark); color: inherit; }
figure { margin: 1rem 0; }
figure img, figure video { max-width: 100%; height: auto; border-radius: 0.4rem; }
.plot { padding: 0.4rem; box-sizing: border-box; background: #ffffff; }
@media (prefers-color-scheme: dark) { .plot { filter: invert(0.93) hue-rotate(180deg); } }
.bars { display: block; width: 100%; max-width: 30rem; height: 7rem; fill: var(--accent); }
pre { margin: 0.3rem 0 0.9rem; padding: 0.7rem 0.9rem; border-radius: 0.5rem; background: var(--card);
  white-space: pre-wrap; overflow-x: auto; }
.whole { white-space: nowrap; }
code { font: 0.86rem/1.5 ui-monospace, monospace; }
summary { cursor: pointer; margin: 0.8rem 0; color: var(--accent); }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: 0.6rem; }
"""


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(name: str, /, *inside: str, **attributes: str) -> Html:
    """An element of HTML; `class_` stands for the attribute `class`. Whatever is not `Html` is escaped."""
    given = "".join(f' {key.rstrip("_")}="{escape(value)}"' for key, value in attributes.items())
    if name in WITHOUT_END:
        return Html(f"<{name}{given}>")
    content = "".join(part if isinstance(part, Html) else escape(part) for part in inside)
    return Html(f"<{name}{given}>{content}</{name}>")


def write_page(file: Path, title: str, *inside: str) -> Path:
    """Write a page."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", Html(STYLE)),
    )
    page = f"<!DOCTYPE html>\n{element('html', head, element('body', *inside), lang='en')}\n"
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, page.encode("utf-8", errors="xmlcharrefreplace"))
    return file


def section(title: str, *inside: str) -> Html:
    """A heading and what stands below it."""
    return element("section", element("h2", title), *inside)


def cards(numbers: Iterable[tuple[str, str]]) -> Html:
    """(name, number) of a few numbers, side by side in large letters."""
    return element(
        "div", *(element("div", element("strong", number), name) for name, number in numbers), class_="cards"
    )


def table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """A table, which scrolls sideways where it is too wide."""
    head = element("tr", *(element("th", cell, scope="col") for cell in heading))
    body = (element("tr", *(element("td", cell) for cell in row)) for row in rows)
    return element("div", element("table", element("thead", head), element("tbody", *body)), class_="wide")


def bullets(sentences: Iterable[str]) -> Html:
    """A list of sentences."""
    return element("ul", *(element("li", _unbroken(sentence)) for sentence in sentences))


def command(line: str) -> Html:
    """A line for a terminal."""
    return element("pre", element("code", _unbroken(line)))


def _unbroken(text: str) -> Html:
    """Text that no browser breaks within a flag such as --learning-rate."""
    words = (
        element("span", word, class_="whole") if word.startswith("--") else escape(word) for word in text.split(" ")
    )
    return Html(" ".join(words))


def link(text: str, file: Path, page: Path) -> Html:
    """A link to a file from a page, which holds as long as both are moved together."""
    way = os.path.relpath(file, page.parent)
    return element("a", text, href=quote(way.replace(os.sep, "/")))


def picture(file: Path, caption: str) -> Html:
    """A plot, embedded."""
    image = element("img", src=_embedded(file), alt=caption, class_="plot")
    return element("figure", image, element("figcaption", caption))


def film(file: Path, page: Path) -> Html:
    """A film, embedded if it is small, else linked from `page`."""
    if file.stat().st_size > MOST_BYTES:
        return element("p", link(file.name, file, page), f" ({file.stat().st_size / 1e6:.0f} MB)")
    if file.suffix == ".mp4":
        moving = element("video", src=_embedded(file), controls="", loop="", muted="")
    else:
        moving = element("img", src=_embedded(file), alt="A film of the policy")
    return element("figure", moving, element("figcaption", file.name))


def histogram(values: Sequence[float], caption: str) -> Html:
    """Bars of how many of `values` lie where, the least and the greatest below."""
    counts, edges = np.histogram(values, bins=min(24, max(6, len(values) // 4)))
    width, tallest = 100 / len(counts), max(counts)
    bars = (
        element("rect", x=f"{i * width + 0.3:.2f}", y=f"{40 - h:.2f}", width=f"{width - 0.6:.2f}", height=f"{h:.2f}")
        for i, h in enumerate(40 * counts / tallest)
    )
    drawn = element("svg", *bars, viewBox="0 0 100 40", preserveAspectRatio="none", class_="bars", role="img")
    return element("figure", drawn, element("figcaption", f"{caption}, from {edges[0]:,.1f} to {edges[-1]:,.1f}"))


def _embedded(file: Path) -> str:
    return f"data:{KINDS[file.suffix]};base64,{base64.b64encode(file.read_bytes()).decode()}"
