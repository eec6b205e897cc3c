"""What the tests of the course share."""

import io

import torch

from lemniscate import course


def says(thing, name, words):
    """The finding on `thing` is that it is wrong, in these words; or in one of several, between bars."""
    finding = course.check(thing, name)
    assert not finding
    assert any(one in finding.sentence for one in words.split("|")), finding.sentence


def passes_from_a_file(thing, name):
    """A right solution passes when it is judged by a file of what was seen, which holds plain values alone."""
    exercise, file = course.EXERCISES[name], io.BytesIO()
    torch.save(dict(exercise.observe(thing)), file)
    file.seek(0)
    finding = exercise.judge(name, torch.load(file, weights_only=True))
    assert finding, finding.sentence
    return finding.sentence


class Solutions:
    """Solutions of exercises in many hands' styles: right ones, and wrong ones with the words that name the cause."""

    def __init__(self):
        self.right, self.wrong = [], []

    def is_right(self, name):
        return lambda solution: self.right.append((name, solution)) or solution

    def is_wrong(self, name, words):
        return lambda solution: self.wrong.append((name, solution, words)) or solution
