"""Objects of a user's own by name."""

import functools
import sys

import pytest

from lemniscate.errors import UserError
from lemniscate.system import named


class Mine:
    class Inner:
        pass

    def __init__(self, x=0):
        self.x = x


def test_what_can_be_imported_has_its_usual_name():
    assert named.name_of(Mine) == "test_named:Mine"
    assert named.name_of(Mine.Inner) == "test_named:Mine.Inner"
    assert named.name_of("anything") == "anything"
    assert named.find("test_named:Mine.Inner") is Mine.Inner
    assert named.find("math:sqrt")(4) == 2


def test_what_cannot_is_found_in_this_process_only():
    made = [lambda x=x: x for x in range(2)]
    names = [named.name_of(function) for function in made]
    assert len(set(names)) == 2
    assert [named.find(name)() for name in names] == [0, 1]
    assert named.name_of(made[0]) == names[0]
    part = named.name_of(functools.partial(Mine, x=3))
    assert named.find(part)().x == 3
    for name in (*names, part):
        named._PASSED.pop(name)  # as another process would have it
        with pytest.raises(UserError, match="made inside a program: pass the object again"):
            named.find(name)


def test_a_class_of_the_main_program_is_asked_for_again(monkeypatch):
    with pytest.raises(
        UserError, match="__main__ has no Gone; it was defined in another program: pass the object again"
    ):
        named.find("__main__:Gone")
    monkeypatch.setattr(sys.modules["__main__"], "Here", Mine, raising=False)
    assert named.find("__main__:Here") is Mine


def test_a_class_defined_again_takes_the_place_of_the_first():
    first = type("Again", (), {"__module__": "__main__", "__qualname__": "Again"})
    second = type("Again", (), {"__module__": "__main__", "__qualname__": "Again"})
    assert named.name_of(first) == named.name_of(second) == "__main__:Again"
    assert named.find("__main__:Again") is second


def test_a_callable_with_arguments():
    assert named.find_callable("test_named:Mine(x=-2.5)")().x == -2.5
    assert named.find_callable("test_named:Mine( x = {'a': [1, None]} )")().x == {"a": [1, None]}
    assert named.find_callable("test_named:Mine")().x == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nowhere:Thing", "nowhere:Thing cannot be found: there is no module nowhere here"),
        ("test_named:Nothing", "test_named has no Nothing"),
        ("test_named:mine", "test_named has no mine: did you mean Mine?"),
        (
            "./test_named.py:Mine",
            "names a file; name its module, without folder and ending, in that folder: test_named:",
        ),
        ("test_named:Mine.y2", "test_named has no Mine.y2."),
        (
            "test_named.py:Mine",
            "names a file; name its module, without folder and ending, in that folder: test_named:Mine.",
        ),
        ("Mine", "'Mine' is no name of an object; it has the form module:name"),
        ("test_named:Mine(x=open('/etc/passwd'))", "cannot be read; it has the form"),
        ("test_named:Mine(x=1", "cannot be read; it has the form"),
        ("test_named:Mine(x=1).__class__", "cannot be read; it has the form"),
        ("test_named:Mine(**{'x': 1})", "cannot be read; it has the form"),
        ("test_named:Mine(1)", "need their names"),
        ("math:pi", "math:pi is neither a function nor a class"),
    ],
)
def test_a_wrong_name_is_said(text, said):
    with pytest.raises(UserError) as raised:
        named.find_callable(text)
    assert said in str(raised.value)


def test_a_folder_is_no_module(tmp_path, monkeypatch):
    (tmp_path / "boat").mkdir()
    (tmp_path / "boat" / "boat.py").write_text("class Boat: ...")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="boat:Boat cannot be found: boat is a folder here; run inside of it"):
        named.find("boat:Boat")
