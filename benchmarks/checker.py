"""The error rates of `course.check` over the zoo of solutions in tests/zoo, as the table of docs/courses.md.

python benchmarks/checker.py [gae Agent …]
"""

import argparse
import contextlib
import io
import re
import sys
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import zoo_files  # noqa: E402
from lemniscate import course  # noqa: E402

COLUMNS = ("right", "false alarm", "wrong", "miss", "named")


class Judged(NamedTuple):
    """A solution of the zoo and the sentence on it."""

    exercise: str
    solution: zoo_files.Solution
    right: bool
    sentence: str

    @property
    def counts(self) -> tuple[str, ...]:
        """The columns of the table that it counts in."""
        if self.solution.kind == "right":
            return ("right",) if self.right else ("right", "false alarm")
        named = not self.right and re.search(self.solution.regex or ".", self.sentence, re.IGNORECASE)
        return ("wrong", "miss") if self.right else ("wrong", "named") if named else ("wrong",)


def judged(exercise: str, solution: zoo_files.Solution) -> Judged:
    """The finding on a solution; a file that is no program is wrong."""
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        warnings.simplefilter("ignore")
        try:
            found = zoo_files.find(zoo_files.execute(solution, f"zoo_{exercise}"), solution.name)
        except Exception as error:  # a syntax error, or a name that is missing at its top level
            return Judged(exercise, solution, False, f"it raised {type(error).__name__}: {error}")
        finding = course.check(found, exercise)
    return Judged(exercise, solution, finding.right, finding.sentence)


def zoo(exercise: str) -> list[Judged]:
    """All solutions of an exercise, judged."""
    files = sorted(zoo_files.ZOO.glob(f"{exercise}.*.py"))
    return [judged(exercise, solution) for file in files for solution in zoo_files.load(file)]


def row(name: str, count: Counter[str]) -> str:
    """A line of the table: the causes as a share of the mistakes that were found."""
    found = count["wrong"] - count["miss"]
    share = f"{count['named'] / found:.0%}" if found else ""
    return f"| {name} | {count['right']} | {count['false alarm']} | {count['wrong']} | {count['miss']} | {share} |"


def main() -> None:
    """Print what is judged wrongly, then the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("exercises", nargs="*", default=list(course.EXERCISES))
    total, rows = Counter[str](), []
    for exercise in parser.parse_args().exercises:
        results = zoo(exercise)
        for each in results:
            if {"false alarm", "miss"} & set(each.counts):
                print(f"{each.counts[-1]}: {exercise}, {each.solution.title}: {each.sentence}", file=sys.stderr)
        count = Counter(column for each in results for column in each.counts)
        total += count
        rows.append(row(f"`{exercise}`", count))
    print("| exercise | right solutions | false alarms | wrong solutions | misses | cause named |")
    print("|---|---|---|---|---|---|", *rows, row("**all**", total), sep="\n")


if __name__ == "__main__":
    main()
