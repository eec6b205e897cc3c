"""The C itself: its functions, its warnings, its memory."""

import ctypes
import re
import subprocess

import numpy as np
import pytest
from exported import BOX, exported, needs_compiler, policy_for

from lemniscate.errors import UserError
from lemniscate.exporting.c_code import c_files, functions
from lemniscate.exporting.compiled import FLAGS, HostPolicy, host_compiler, run_tool

pytestmark = needs_compiler

HARNESS = """
#include <math.h>
#include <stdint.h>
#include <string.h>
FUNCTIONS
double worst(int relative, double low, double high, uint32_t step);
double worst(int relative, double low, double high, uint32_t step)
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


def worst(folder, function, truth, relative, low, high, step):
    text = HARNESS.replace("FUNCTIONS", "\n".join(functions({function}))).replace("TRUTH", truth)
    (folder / "worst.c").write_text(text.replace("CALL", f"policy_{function}"))
    library = folder / f"{function}.so"
    run_tool([host_compiler(), "-std=c99", "-O2", "-fPIC", "-shared", "-o", str(library), "worst.c", "-lm"], folder)
    call = ctypes.CDLL(str(library)).worst
    call.restype, call.argtypes = ctypes.c_double, (ctypes.c_int, ctypes.c_double, ctypes.c_double, ctypes.c_uint32)
    return call(relative, low, high, step)


@pytest.mark.parametrize(("function", "truth", "relative", "low", "high", "bound"), BOUNDS)
def test_functions_are_as_exact_as_their_comments_say(tmp_path, function, truth, relative, low, high, bound):
    assert worst(tmp_path, function, truth, relative, low, high, step=1009) <= bound  # four million numbers


@pytest.mark.long
@pytest.mark.parametrize(("function", "truth", "relative", "low", "high", "bound"), BOUNDS)
def test_functions_are_as_exact_at_every_float32(tmp_path, function, truth, relative, low, high, bound):
    assert worst(tmp_path, function, truth, relative, low, high, step=1) <= bound


def test_ends_of_functions_are_finite(tmp_path):
    """No NaN and no infinity is made of finite numbers, so that a policy's answer is one."""
    for function in ("exp", "sigmoid", "tanh", "log", "sqrt", "sin", "cos", "erf"):
        text = "#include <stdint.h>\n#include <string.h>\n" + "\n".join(functions({function}))
        (tmp_path / "f.c").write_text(
            f"{text}\nfloat f(float x);\nfloat f(float x) {{ return policy_{function}(x); }}\n"
        )
        run_tool([host_compiler(), "-std=c99", "-fPIC", "-shared", "-o", f"{function}.so", "f.c"], tmp_path)
        f = ctypes.CDLL(str(tmp_path / f"{function}.so")).f
        f.restype, f.argtypes = ctypes.c_float, (ctypes.c_float,)
        assert np.isfinite([f(x) for x in (0, -0.0, 1e-45, -1e-45, 3.4e38, -3.4e38, 88.1, -87.1, 1e6)]).all(), function


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
    copy, compiler = exported(policy_for()), host_compiler()
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


def test_a_run_cannot_write_code_into_a_comment():
    copy = exported(policy_for())
    evil = "*/ int main(void) { return 1; }\n#error evil\\\n/*"
    for name, text in c_files(copy.program, BOX, copy.obs[:2], copy.true[:2], title=evil, origin=evil).items():
        assert text.count("#error") == text.count("* / int main(void)"), name
        assert not re.search(r"^#error", text, re.MULTILINE)


@pytest.mark.parametrize(("scale", "bound"), [(1, "1e-04F"), (1e6, "1e+01F")])
def test_the_bound_of_the_self_test_grows_with_the_actions(scale, bound):
    copy = exported(policy_for())
    header = c_files(copy.program, BOX, copy.obs[:1], np.full((1, 3), scale), title="", origin="")["policy.h"]
    assert f"#define POLICY_SELF_TEST_BOUND {bound}\n" in header


def test_a_compiler_that_refuses_is_quoted():
    files = exported(policy_for()).files()
    files["policy.c"] = files["policy.c"].replace("int i;", "")
    with pytest.raises(UserError, match=r"failed: policy.c:\d+.*error"):
        HostPolicy(files, host_compiler())
