"""Processes that start at once: forked from one that has imported what takes seconds."""

import atexit
import json
import os
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

TESTS = Path(__file__).parent
LEMNISCATE = "import sys, envpool, torch, torch.utils.tensorboard, lemniscate.cli.commands, lemniscate.api.plots, toy; torch.set_num_threads(1)"

SERVER = """
import gc, json, os, signal, sys

def begin(job):
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background ignores it
    for name, number in (("out", 1), ("err", 2)):
        file = os.open(os.path.join(job["folder"], name), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(file, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(job["cwd"])
    os.environ.clear()
    os.environ.update(job["environment"])
    exec(compile(job["code"], "<fork>", "exec"), {"__name__": "__main__"})

gc.collect()
gc.freeze()  # what is imported is not written to by a collection, and stays shared
for line in sys.stdin:
    job = json.loads(line)
    waiter = os.fork()
    if not waiter:
        child = os.fork()
        if not child:
            begin(job)
            sys.exit()
        print(child, flush=True)
        code = os.path.join(job["folder"], "code")
        with open(code + ".tmp", "w") as file:
            file.write(str(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])))
        os.rename(code + ".tmp", code)
        os._exit(0)
    while sum(os.waitpid(-1, os.WNOHANG)):
        pass
"""


class Forks:
    """A process that has run `imports`, from which others are forked."""

    def __init__(self, imports=LEMNISCATE, **environment):
        paths = os.pathsep.join(filter(None, [*sys.path, str(TESTS)]))
        environment = {**os.environ, "PYTHONPATH": paths, "COLUMNS": "200", **environment}
        program = f"{imports}\n{SERVER}"
        self._server = subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self._environment = environment
        atexit.register(self.close)

    def start(self, code, cwd=".", **environment):
        """Start a program, given as text, in a session of its own."""
        folder = Path(mkdtemp(prefix="fork-"))
        for name in ("out", "err"):  # it may be killed before it opens them
            (folder / name).touch()
        job = {"code": code, "cwd": str(Path(cwd).resolve()), "folder": str(folder)}
        job["environment"] = {**self._environment, **environment}
        print(json.dumps(job), file=self._server.stdin, flush=True)
        return Forked(int(self._server.stdout.readline()), folder)

    def close(self):
        """End the process; those forked from it go on."""
        self._server.communicate()


class Forked:
    """A process, used like a `subprocess.Popen` with text; what it writes is kept in files."""

    def __init__(self, pid, folder):
        self.pid, self.returncode, self._folder = pid, None, folder

    def poll(self):
        """Its exit code, negative for a signal; None while it runs."""
        if self.returncode is None and (self._folder / "code").exists():
            self.returncode = int((self._folder / "code").read_text())
        return self.returncode

    def wait(self, timeout=600.0):
        """Wait for the end. Raises `subprocess.TimeoutExpired`."""
        deadline = time.monotonic() + timeout
        while self.poll() is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(0.005)
        return self.returncode

    def communicate(self, timeout=600.0):
        """Wait for the end; (standard output, standard error)."""
        self.wait(timeout)
        return (self._folder / "out").read_text(), (self._folder / "err").read_text()

    def send_signal(self, signum):
        """Send a signal if it still runs."""
        if self.poll() is None:
            os.kill(self.pid, signum)

    def terminate(self):
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self):
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


@cache
def forks():
    """The process that lemniscate's commands of this test session are forked from."""
    return Forks()


def command(*arguments, before="", cwd=".", server=None, **environment):
    """Start a command of lemniscate, after the statements `before`, with more variables in its environment."""
    words = list(map(str, arguments))
    code = f"import sys\nsys.argv = {['lemniscate', *words]!r}\n{before}\nimport lemniscate.cli\n"
    return (server or forks()).start(f"{code}sys.exit(lemniscate.cli.main())", cwd, **environment)
