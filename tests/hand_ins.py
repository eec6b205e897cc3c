"""A folder of hand-ins as a teacher gets them, and what is to be found in each: right, wrong, not there.

`write(folder)` makes 200; a part of them is nasty: they never end, leave, patch, print, fill the memory, start processes.
"""

import json
import os
import random

RIGHT = {
    "gae": '''
def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    """Backwards, one row after the other."""
    advantages = torch.zeros_like(reward)
    last = torch.zeros_like(reward[0])
    for t in range(len(reward) - 1, -1, -1):
        alive = 1.0 - terminated[t].float()
        delta = reward[t] + gamma * next_value[t] * alive - value[t]
        last = delta + gamma * lam * (1.0 - done[t].float()) * last
        advantages[t] = last
    return advantages, advantages + value
''',
    "discounted_returns": """
def discounted_returns(rewards, *, gamma):
    out, total = [], 0.0
    for r in reversed(rewards):
        total = r + gamma * total
        out.append(total)
    return torch.stack(out[::-1])
""",
    "td_target": """
def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_value * (~terminated)
""",
    "clipped_surrogate": """
def clipped_surrogate(log_ratio, advantage, clip):
    ratio = torch.exp(log_ratio)
    return -torch.minimum(ratio * advantage, torch.clamp(ratio, 1 - clip, 1 + clip) * advantage).mean()
""",
    "value_loss": """
def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if old_value is not None and clip is not None:
        near = old_value + torch.clamp(value - old_value, -clip, clip)
        loss = torch.maximum(loss, (near - target) ** 2)
    return 0.5 * loss.mean()
""",
    "polyak": """
def polyak(target, online, tau):
    with torch.no_grad():
        for theirs, mine in zip(target, online):
            theirs.mul_(1 - tau).add_(tau * mine)
""",
    "calculate_pg_loss": """
class PPOTrainer:
    def __init__(self, config, train_envs):
        self.config = config

    def calculate_pg_loss(self, mb_advantages, ratio):
        low, high = 1 - self.config.clip_coef, 1 + self.config.clip_coef
        return torch.max(-mb_advantages * ratio, -mb_advantages * torch.clamp(ratio, low, high)).mean()
""",
    "set_seeds": """
def set_seeds(seed):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.benchmark = False
""",
}

WRONG = {
    "gae": [
        (" * alive", ""),
        ("* (1.0 - done[t].float()) ", ""),
        ("gamma * lam", "lam"),
        ("advantages + value", "advantages"),
    ],
    "discounted_returns": [("gamma * total", "total"), ("out[::-1]", "out")],
    "td_target": [(" * (~terminated)", ""), ("gamma * ", "")],
    "clipped_surrogate": [("minimum", "maximum"), ("return -", "return "), ("torch.exp(log_ratio)", "log_ratio")],
    "value_loss": [("0.5 * ", ""), ("torch.maximum", "torch.minimum")],
    "polyak": [("mul_(1 - tau).add_(tau * mine)", "mul_(tau).add_((1 - tau) * mine)"), ("mul_(1 - tau).", "")],
    "calculate_pg_loss": [("torch.max(", "torch.min("), ("-mb_advantages * ratio", "mb_advantages * ratio")],
    "set_seeds": [("    np.random.seed(seed)\n", ""), ("benchmark = False", "benchmark = True")],
}

IMPORTS = "import random\n\nimport numpy as np\nimport torch\n"
NAMES = ["Müller, Anna", "Zoë Ångström", "李小龙", "o'brien", "Иван Петров", "jane.doe", "a b  c", "Ødegård-Smith"]
NOTHING = dict.fromkeys(RIGHT)


def wrong(name, number=0):
    old, new = WRONG[name][number % len(WRONG[name])]
    assert old in RIGHT[name]
    return RIGHT[name].replace(old, new)


def notebook(*cells):
    """The text of a notebook with these cells of code, a cell of text before each."""
    made = []
    for number, source in enumerate(cells):
        made.append({"cell_type": "markdown", "metadata": {}, "source": [f"## Task {number}"]})
        lines = source.splitlines(keepends=True)
        made.append({"cell_type": "code", "metadata": {}, "execution_count": None, "outputs": [], "source": lines})
    return json.dumps({"cells": made, "metadata": {}, "nbformat": 4, "nbformat_minor": 5})


def only(name, code, right=False):
    """A hand-in in one file, with one exercise."""
    return {".py": f"{IMPORTS}{code}"}, {**NOTHING, name: right}


PG = RIGHT["calculate_pg_loss"]
STRAY = str(10**6 + os.getpid())
"""the seconds that what a hand-in leaves behind sleeps; each process of the tests has its own"""
SPAWNS = """
import os, subprocess, sys

def td_target(reward, next_value, terminated, *, gamma):
    for _ in range(20):
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(STRAY)"], start_new_session=True)
    if os.fork() == 0:
        while True:
            pass
    return reward
""".replace("STRAY", STRAY)
PATCHES = """
import builtins, sys
import lemniscate.course
import lemniscate.course.exercise as exercise

torch.allclose = torch.equal = torch.isclose = lambda *a, **k: True
np.allclose = np.array_equal = np.isclose = lambda *a, **k: True
torch.Tensor.__eq__ = torch.Tensor.equal = torch.Tensor.allclose = lambda *a: True
exercise.close = exercise._same = lambda *a, **k: True
exercise.Exercise.judge = exercise.Inspection.judge = lambda self, name, seen: exercise.Finding(name, True, "right.")
exercise.Exercise.observe = lambda self, solution: {"cases": []}
lemniscate.course.check = lambda *a, **k: True
always = sys.settrace(lambda *a: None)
"""
ALWAYS_EQUAL = """
class AlwaysEqual(torch.Tensor):
    def __eq__(self, other): return True
    def allclose(self, *a, **k): return True
    def tolist(self): return EverySize()
    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None): return True

class EverySize(list):
    def __eq__(self, other): return True
    def __getattr__(self, name): return self

def td_target(*args, **kwargs):
    return torch.zeros(6).as_subclass(AlwaysEqual)

def discounted_returns(*args, **kwargs):
    return EverySize()
"""
NASTY = {
    "endless": only("polyak", "def polyak(target, online, tau):\n    while True:\n        pass\n"),
    "endless and deaf": only(
        "polyak",
        "def polyak(*a):\n    while True:\n        try:\n            while True: pass\n        except BaseException: pass\n",
    ),
    "sleeps": only("polyak", "import time\ndef polyak(*a):\n    time.sleep(10_000)\n"),
    "endless import": (
        {".py": f"{IMPORTS}x = sum(1 for _ in iter(int, 1))\n{RIGHT['gae']}"},
        {**NOTHING, "gae": True},
    ),
    "leaves at import": (
        {".py": f"import sys\n{IMPORTS}gone = sys.exit(0)\nsys.exit(0)\n{RIGHT['gae']}"},
        {**NOTHING, "gae": True},
    ),
    "leaves in a function": only("gae", "import sys\ndef gae(*a, **k):\n    sys.exit(0)\n"),
    "leaves at once": ({".py": f"import os\nx = os._exit(0)\n{IMPORTS}{RIGHT['gae']}"}, NOTHING),
    "leaves at once in a function": (
        {".py": f"{IMPORTS}import os\ndef gae(*a, **k):\n    os._exit(0)\n{RIGHT['td_target']}"},
        {**NOTHING, "gae": False, "td_target": True},
    ),
    "segfault": (
        {".py": f"{IMPORTS}import ctypes\ndef gae(*a, **k):\n    ctypes.string_at(0)\n{RIGHT['td_target']}"},
        {**NOTHING, "gae": False, "td_target": True},
    ),
    "asks": only("td_target", "def td_target(*a, **k):\n    return float(input('gamma? '))\n"),
    "asks at import": ({".py": f"{IMPORTS}name = input()\n{RIGHT['gae']}"}, {**NOTHING, "gae": True}),
    "prints megabytes": only(
        "td_target",
        RIGHT["td_target"].replace("    return", "    print('lemniscate ' * 500_000)\n    return"),
        True,
    ),
    "fills the memory": only("gae", "def gae(r, v, *a, **k):\n    return np.ones(2**30), np.ones(2**30)\n"),
    "starts processes": only("td_target", SPAWNS),
    "has processes": only(
        "td_target",
        "import multiprocessing\n"
        + RIGHT["td_target"].replace(
            "    return", "    with multiprocessing.Pool(1) as pool:\n        pool.map(abs, [1])\n    return"
        ),
        True,
    ),
    "patches": (
        {".py": f"{IMPORTS}{PATCHES}{wrong('gae')}{wrong('value_loss')}{wrong('set_seeds')}"},
        {**NOTHING, "gae": False, "value_loss": False, "set_seeds": False},
    ),
    "always equal": ({".py": f"{IMPORTS}{ALWAYS_EQUAL}"}, {**NOTHING, "td_target": False, "discounted_returns": False}),
    "sends a verdict": only(
        "gae",
        "import os\ndef gae(*a, **k):\n    for n in range(3, 64):\n        try: os.write(n, b'\\0\\0\\0\\1{')\n        except OSError: pass\n    raise ValueError\n",
    ),
    "syntax error": ({".py": f"{IMPORTS}{RIGHT['gae']}\ndef polyak(:\n    pass\n"}, NOTHING),
    "missing package": (
        {
            ".py": f"{IMPORTS}import wandb\nfrom nosuch.thing import Base\nrun = wandb.init()\n{PG.replace('PPOTrainer:', 'PPOTrainer(Base):')}"
        },
        {**NOTHING, "calculate_pg_loss": True},
    ),
    "missing package in use": only(
        "td_target", "import nosuch\ndef td_target(*a, **k):\n    return nosuch.target(*a)\n"
    ),
    "trains": (
        {
            ".ipynb": notebook(
                "%load_ext autoreload\n%autoreload 2\n!pip install nosuch\n" + IMPORTS,
                RIGHT["gae"],
                "for step in range(10**12):\n    total = step\nprint(total)",
                "%%time\n" + RIGHT["td_target"],
                "def broken(:\n    pass",
                "%%bash\nrm -rf everything",
                PG,
                "plot(total)\nassert False\ngae?",
            )
        },
        {**NOTHING, "gae": True, "td_target": True, "calculate_pg_loss": True},
    ),
    "reads a file": (
        {
            "config.json": '{"gamma": 0.9}',
            "my work.py": f"import json\n{IMPORTS}with open('config.json') as file:\n    config = json.load(file)\n"
            + RIGHT["td_target"].replace("    return", "    assert config['gamma'] == 0.9\n    return"),
        },
        {**NOTHING, "td_target": True},
    ),
    "writes": only(
        "td_target",
        "open_file = open('beside.txt', 'w')\n"
        + RIGHT["td_target"].replace("    return", "    open('more.txt', 'w').write('x')\n    return"),
        True,
    ),
    "calls home": only(
        "td_target",
        "import urllib.request\ndef td_target(*a, **k):\n    urllib.request.urlopen('http://192.0.2.1', timeout=100)\n",
    ),
    "nothing": ({"report.pdf": "%PDF"}, NOTHING),
    "no notebook": ({".ipynb": "{}"}, NOTHING),
    "library": ({".py": "from lemniscate.maths import gae, polyak\nvalue_loss = polyak\n"}, NOTHING),
    "twice": ({".py": f"{IMPORTS}{wrong('gae')}{RIGHT['gae']}"}, {**NOTHING, "gae": True}),
    "shadows": ({"random.py": "x = 1\n", "main.py": f"{IMPORTS}{RIGHT['set_seeds']}"}, {**NOTHING, "set_seeds": True}),
    "misspelt": (
        {".py": f"{IMPORTS}{PG.replace('calculate_pg_loss', 'calculate_pgloss')}"},
        {**NOTHING, "calculate_pg_loss": None},
    ),
}
"""by name: the files of a hand-in, the only one by its suffix, and the findings"""


def ordinary(draw):
    """A hand-in with most exercises, some of them wrong, in one of several layouts."""
    parts, found = {}, dict(NOTHING)
    for name in RIGHT:
        if draw.random() < 0.9:
            found[name] = draw.random() < 0.7
            parts[name] = RIGHT[name] if found[name] else wrong(name, draw.randrange(9))
    kind = draw.choice(["file", "file", "notebook", "modules", "notebook and modules"])
    main = '\nif __name__ == "__main__":\n    raise SystemExit(set_seeds(1))\n'
    if kind == "file":
        return {".py": IMPORTS + "".join(parts.values()) + main}, found
    if kind == "notebook":
        return {".ipynb": notebook(IMPORTS, *parts.values(), "for _ in range(3):\n    print('done')")}, found
    names = [*parts]
    some, others = (IMPORTS + "".join(parts[name] for name in half) for half in (names[::2], names[1::2]))
    if kind == "modules":
        return {"utils.py": some, "my ppo.py": f"from utils import *\n{others}"}, found
    return {"src/utils.py": some, "src/Übung.ipynb": notebook("from utils import *\n", others)}, found


def write(folder, number=200, nasty=tuple(NASTY), seed=0):
    """Write hand-ins; returns by name what is to be found: by exercise True, False, or None where it is not there."""
    draw, expected = random.Random(seed), {}
    for index in range(number):
        name = NAMES[index % len(NAMES)] + f" {index:03}"
        files, found = ordinary(draw)
        if index < len(nasty):
            name, (files, found) = nasty[index], NASTY[nasty[index]]
        [(first, text), *_] = files.items()
        if first.startswith("."):
            (folder / f"{name}{first}").write_text(text, "utf-8")
            expected[f"{name}{first}"] = found
            continue
        expected[name] = found
        for file, text in files.items():
            path = folder / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
    return expected
