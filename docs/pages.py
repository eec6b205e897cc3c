"""The pages of the documentation site, as Markdown and pictures in build/docs; mkdocs makes HTML of them.

    python docs/pages.py && mkdocs build --strict

README.md is the home page, the notebooks are pages with their outputs, and a link that leaves docs/ takes its file
along: a program becomes a page with its text. Two comments in a page are filled in:

    <!-- file: examples/callback.py -->    the text of the file
    <!-- words: CleanRL -->                the table of a library's words beside ours, from lemniscate.run.fields
"""

import base64
import json
import re
import shutil
from functools import partial
from os.path import relpath
from pathlib import Path

from latex2mathml.converter import convert

from lemniscate.run import fields as glossary

ROOT = Path(__file__).parents[1]
OUT = ROOT / "build" / "docs"
HOME = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}

LINK = re.compile(r"(?<=\]\()([^)#\s]+)")
FILE = re.compile(r"<!-- file: (.+?) -->")
WORDS = re.compile(r"<!-- words: (.+?) -->")
FORMULA = re.compile(r"\$([^$]+)\$")
COLOUR = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
PICTURES = {"image/png": "png", "image/gif": "gif", "image/webp": "webp", "image/jpeg": "jpg"}


def address(file: Path) -> Path:
    """The path of a project's file in the site's folder."""
    name = file.relative_to(ROOT)
    if str(name) in HOME or name.name == "llms.txt":
        return OUT / HOME.get(str(name), name)
    if name.suffix == ".py":
        return (OUT / "source" / name).with_suffix(".md")
    place = OUT / name.relative_to("docs") if name.parts[0] == "docs" else OUT / "files" / name
    return place.with_suffix(".md") if name.suffix == ".ipynb" else place


def write(file: Path) -> None:
    """Write the page of a file, and those of the files that it links to."""
    place = address(file)
    if place.exists():
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".md":
        place.touch()  # a page that this one links to may link back
        place.write_text(relinked(file, filled(file.read_text())))
    elif file.suffix == ".ipynb":
        place.write_text(relinked(file, notebook(json.loads(file.read_text()), place.with_suffix(""))))
    elif file.suffix == ".py":
        place.write_text(f"# {file.name}\n\n`{file.relative_to(ROOT)}`\n\n{fenced(file.read_text(), 'python')}")
    else:
        shutil.copyfile(file, place)


def relinked(file: Path, text: str) -> str:
    """The text of a page with each link to a file of the project turned into one to its page."""

    def turned(link: re.Match[str]) -> str:
        target = (file.parent / link[0]).resolve()
        if "://" in link[0]:
            return link[0]
        if not target.is_file():
            raise FileNotFoundError(f"{file.relative_to(ROOT)} links to {link[0]}, which is no file.")
        write(target)
        return relpath(address(target), address(file).parent)

    return LINK.sub(turned, text)


def filled(text: str) -> str:
    """The text with the files and the tables that its comments ask for."""
    text = FILE.sub(lambda found: fenced((ROOT / found[1]).read_text(), "python"), text)
    return WORDS.sub(lambda found: glossary.words_of(found[1]), text)


def notebook(record: dict, folder: Path) -> str:
    """A notebook with its outputs as Markdown; its pictures go into `folder`."""
    parts = []
    for number, cell in enumerate(record["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(FORMULA.sub(formula, source))
        else:
            parts.append(fenced(source, "python"))
            parts += map(partial(output, folder, number), cell["outputs"], range(len(cell["outputs"])))
    return "\n\n".join(filter(None, parts)) + "\n"


def formula(found: re.Match[str]) -> str:
    """A formula as MathML, in a span because a line that begins with <math> would be a paragraph of its own."""
    return f"<span>{convert(found[1].replace(chr(10), ' '))}</span>"


def output(folder: Path, cell: int, record: dict, number: int) -> str:
    """One output of a cell as Markdown."""
    data = record.get("data", {"text/plain": record.get("text", "")})
    for kind, suffix in PICTURES.items():
        if kind in data:
            folder.mkdir(exist_ok=True)
            picture = folder / f"{cell}-{number}.{suffix}"
            picture.write_bytes(base64.b64decode("".join(data[kind])))
            return f'<img src="{folder.name}/{picture.name}" alt="output of the cell above">'
    if "text/html" in data:
        return f'<div class="output">{"".join(data["text/html"])}</div>'
    lines = COLOUR.sub("", "".join(data.get("text/plain", ""))).split("\n")
    said = "\n".join(line.rstrip("\r").rpartition("\r")[2] for line in lines).strip("\n")  # as a terminal shows it
    return fenced(said, "output") if said.strip() else ""


def fenced(text: str, language: str) -> str:
    """A block of code."""
    return f"````{language}\n{text.strip()}\n````\n"


def main() -> None:
    """Write every page again."""
    shutil.rmtree(OUT, ignore_errors=True)
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs" / "tutorial").glob("*.ipynb")]
    for file in [*map(ROOT.joinpath, HOME), *pages, ROOT / "docs" / "style.css", ROOT / "docs" / "images" / "logo.svg"]:
        write(file)
    index = relinked(ROOT / "llms.txt", (ROOT / "llms.txt").read_text())
    (OUT / "llms.txt").write_text(re.sub(r"\.md(?=[)#])", ".html", index))


if __name__ == "__main__":
    main()
