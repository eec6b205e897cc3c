"""The C itself: its functions, its warnings, its memory."""

import ctypes
import math
import re
import subprocess

import numpy as np
import pytest
from exported import BOX, exported, needs_compiler, plain, policy_for

from lemniscate.errors import UserError
from lemniscate.exporting.c_code import c_files, comment, functions
from lemniscate.exporting.compiled import FLAGS, HostPolicy, host_compiler, run_tool
from lemniscate.exporting.deployed import difference_units
from lemniscate.exporting.parity import compare
from lemniscate.spec import Box, MultiDiscrete

pytestmark = needs_compiler

HARNESS = """
double worst_NUMBER(int relative, double low, double high, uint32_t step);
double worst_NUMBER(int relative, double low, double high, uint32_t step)
{
    double largest = 0.0;
    uint32_t bits = 0;
    do {
        float y;
        memcpy(&y, &bits, sizeof y);
        if (y == y && y >= low && y <= high) {
            const double x = (double)y, truth = TRUTH;
            const double error = fabs((double)CALL(y) - truth) / (relative ? fabs(truth) : 1.0);
            largest = !(error <= largest) ? error : largest;
        }
        bits += step;
    } while (bits >= step);
    return largest;
}
"""

BOUNDS = [
    # function, truth, whether relative, from, to, bound
    ("exp", "exp(x)", True, -87, 88, 4e-7),
    ("sigmoid", "1.0 / (1.0 + exp(-x))", False, -1e30, 1e30, 2e-7),
    ("tanh", "tanh(x)", False, -1e30, 1e30, 3e-7),
    ("sqrt", "sqrt(x)", True, 1.2e-38, 3.4e38, 2e-7),
    ("log", "log(x)", False, 0.9, 1.1, 2e-7),
    ("log", "log(x)", True, 1.2e-38, 0.5, 4e-7),
    ("log", "log(x)", True, 2, 3.4e38, 4e-7),
    ("sin", "sin(x)", False, -1000, 1000, 4e-7),
    ("cos", "cos(x)", False, -1000, 1000, 4e-7),
    ("erf", "erf(x)", False, -1e30, 1e30, 7e-7),
    ("floor", "floor(x)", False, -1e30, 1e30, 0),
]


ENDS = "float f_NAME(float x);\nfloat f_NAME(float x) { return policy_NAME(x); }\n"
NAMES = sorted({bound[0] for bound in BOUNDS})


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """All functions, `worst_N` of each line of the table, and `f_NAME`, which has a number from ctypes."""
    folder = tmp_path_factory.mktemp("functions")
    texts = ["#include <math.h>\n#include <stdint.h>\n#include <string.h>"]
    texts.append(functions("".join(f"policy_{name}(" for name in NAMES)))
    for number, (name, truth, *_) in enumerate(BOUNDS):
        text = HARNESS.replace("NUMBER", str(number)).replace("TRUTH", truth)
        texts.append(text.replace("CALL", f"policy_{name}"))
    texts += [ENDS.replace("NAME", name) for name in NAMES]
    (folder / "functions.c").write_text("\n".join(texts))
    command = [host_compiler(), "-std=c99", "-O2", "-fPIC", "-shared", "-o", "functions.so", "functions.c", "-lm"]
    run_tool(command, folder)
    return ctypes.CDLL(str(folder / "functions.so"))


def worst(library, number, step):
    _, _, relative, low, high, _ = BOUNDS[number]
    call = library[f"worst_{number}"]
    call.restype, call.argtypes = ctypes.c_double, (ctypes.c_int, ctypes.c_double, ctypes.c_double, ctypes.c_uint32)
    return call(relative, low, high, step)


every_bound = pytest.mark.parametrize("number", range(len(BOUNDS)), ids=[f"{bound[0]}-{bound[3]}" for bound in BOUNDS])


@every_bound
def test_functions_are_as_exact_as_their_comments_say(library, number):
    assert worst(library, number, step=1009) <= BOUNDS[number][-1]  # four million numbers


@pytest.mark.long
@every_bound
def test_functions_are_as_exact_at_every_float32(library, number):
    assert worst(library, number, step=1) <= BOUNDS[number][-1]


def test_ends_of_functions_are_finite(library):
    """No NaN and no infinity is made of finite numbers, so that a policy's answer is one."""
    for name in NAMES:
        f = library[f"f_{name}"]
        f.restype, f.argtypes = ctypes.c_float, (ctypes.c_float,)
        assert np.isfinite([f(x) for x in (0, -0.0, 1e-45, -1e-45, 3.4e38, -3.4e38, 88.1, -87.1, 1e6)]).all(), name


def test_only_functions_that_are_called_are_written():
    assert re.findall(r"float policy_(\w+)\(", functions("y = policy_tanh(x);")) == ["exp", "sigmoid", "tanh"]
    assert functions("") == ""
    for name in NAMES:
        text = functions(f"policy_{name}(")
        assert set(re.findall(r"policy_(\w+)\(", text)) == set(re.findall(r"static \w+ policy_(\w+)\(", text)), name


MAIN = """
#include "policy.h"
#include <stdio.h>
int main(void)
{
    float obs[POLICY_OBSERVATIONS] = {0}, action[POLICY_ACTIONS];
    int i;
    const float extremes[] = {0.0F, 3.4e38F, -3.4e38F, 1e-42F, 1e10F};
    for (i = 0; i < 5 * POLICY_OBSERVATIONS; ++i) {
        obs[i % POLICY_OBSERVATIONS] = extremes[i % 5];
        policy_act(obs, action);
    }
    obs[0] = 0.0F / obs[0] * 0.0F;
    return policy_self_test() < POLICY_SELF_TEST_BOUND ? 0 : 1;
}
"""


def test_sanitizers_find_nothing(tmp_path):
    copy = exported(policy_for(network="simba", normalize_observations=True))
    for name, text in {**copy.files(), "main.c": MAIN}.items():
        (tmp_path / name).write_text(text)
    sanitize = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g"]
    try:
        run_tool([host_compiler(), *FLAGS[:5], *sanitize, "policy.c", "main.c", "-o", "main"], tmp_path)
    except UserError as error:
        pytest.skip(str(error))
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_it_includes_nothing_but_integers_and_memcpy_and_has_no_double():
    text = exported(policy_for(network="simba", activation="silu")).files()["policy.c"]
    included = [line for line in text.splitlines() if line.startswith("#include")]
    assert included == ['#include "policy.h"', "#include <stdint.h>", "#include <string.h>"]
    assert "malloc" not in text
    assert "double " not in text.replace("no number is a double", "")


def test_a_header_of_cpp_too(tmp_path):
    """C++ finds the functions of the C file: a program of both is linked, and ends well."""
    copy, compiler = plain(), host_compiler()
    program = (
        '#include "policy.h"\nint main() { float x[POLICY_OBSERVATIONS] = {}, y[POLICY_ACTIONS]; policy_act(x, y); }\n'
    )
    for name, text in {**copy.files(), "use.cpp": program}.items():
        (tmp_path / name).write_text(text)
    run_tool([compiler, *FLAGS[:5], "-c", "policy.c", "-o", "policy.o"], tmp_path)
    try:
        run_tool([compiler.replace("cc", "c++"), "-Wall", "-Werror", "use.cpp", "policy.o", "-o", "use"], tmp_path)
    except UserError as error:
        if "did not run" in str(error):
            pytest.skip("there is no C++ compiler")
        raise
    assert subprocess.run([tmp_path / "use"]).returncode == 0


@pytest.mark.parametrize("text", ["*/", "*\\/", "*/*", "/*/", "*\\/*", "**//", "*\n/", "/\\*"])
def test_no_text_ends_or_begins_a_comment(text):
    assert "*/" not in comment(text)
    assert "/*" not in comment(text)


def test_a_run_cannot_write_code_into_a_comment():
    copy = plain()
    evil = "*/ int main(void) { return 1; }\n#error evil\\\n/*"
    for name, text in c_files(copy.program, BOX, copy.obs[:2], copy.true[:2], title=evil, origin=evil).items():
        assert text.count("#error") == text.count("* / int main(void)"), name
        assert not re.search(r"^#error", text, re.MULTILINE)


NEWTONS = Box((-500.0, -1e-3, -math.inf), (500.0, 1e-3, math.inf))
"""a wide range, a narrow one, and none"""


def test_differences_are_shares_of_the_range_of_each_action():
    """A millionth of the range counts the same in newtons and in radians; without a range the largest action counts."""
    true = np.array([[100.0, 2e-4, -3.0], [-100.0, 1e-4, 30.0]], dtype=np.float32)
    units = difference_units(NEWTONS, true)
    np.testing.assert_allclose(units, [500, 1e-3, 30], rtol=1e-6)
    off = true + np.array([[2e-3, 0, 0], [0, 2e-8, 0]])
    found = compare(off, true, units, 1e-5)
    assert found["max_difference"] == pytest.approx(2e-5, rel=0.01)
    assert found["max_abs_difference"] == pytest.approx(2e-3, rel=0.01)
    assert found["above_tolerance"] == 1  # 2e-3 of 500 N is none
    assert (difference_units(MultiDiscrete((3, 5), (0, 0)), true[:, :2]) == 1).all()
    (coarse,) = difference_units(Box((1000.0,), (1000.001,)), true[:, :1])
    assert np.spacing(np.float32(1000)) / coarse <= 1e-5  # float32 has some sixteen numbers there


def test_the_self_test_counts_in_shares_of_the_range():
    """An export that is wrong by a thousandth of each range fails by the same number in every unit."""
    copy = exported(policy_for(NEWTONS))
    tests = copy.obs[:16], copy.true[:16]
    bound = float(re.findall(r"SELF_TEST_BOUND ([\d.e-]+)F", copy.files()["policy.h"])[0])
    for coordinate, unit in enumerate(difference_units(NEWTONS, copy.true[:16])):
        wrong = tests[1].copy()
        wrong[:, coordinate] += 1e-3 * unit
        host = HostPolicy(c_files(copy.program, NEWTONS, tests[0], wrong, title="", origin=""), host_compiler())
        assert host.self_test() == pytest.approx(1e-3, rel=0.05)
        assert bound < 1e-3
    assert copy.host().self_test() < bound / 10


def test_a_compiler_that_refuses_is_quoted():
    files = plain().files()
    files["policy.c"] = files["policy.c"].replace("int i;", "")
    with pytest.raises(UserError, match=r"failed: policy.c:\d+.*error"):
        HostPolicy(files, host_compiler())
