"""What the tests of the course share."""

from lemniscate import course


def says(thing, name, words):
    """The finding on `thing` is that it is wrong, in these words."""
    finding = course.check(thing, name)
    assert not finding
    assert words in finding.sentence, finding.sentence
