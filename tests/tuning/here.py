"""Places of a set of runs that are this very process: a run is trained where it is started."""

import contextlib

import pytest

from lemniscate.cli import main
from lemniscate.run.places import LOG


class Here:
    """The interface of `lemniscate.run.places.Places`, without the seconds that a process takes to begin."""

    count, free = 1, True

    def __init__(self, *_):
        self._codes = {}

    @property
    def running(self):
        return list(self._codes)

    def start(self, run, options):
        with (run / LOG).open("a") as log, contextlib.redirect_stderr(log), contextlib.redirect_stdout(log):
            self._codes[run] = main(["resume", str(run), *options])

    def ended(self):
        codes, self._codes = self._codes, {}
        return codes

    def stop(self, runs=None):
        pass

    def close(self):
        pass


@contextlib.contextmanager
def in_this_process(places=Here):
    """Sweeps and searches train their runs here meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lemniscate.sweeps.sweep.places_on", places)
        patch.setattr("lemniscate.sweeps.sweep.POLL_SECONDS", 0.0)
        yield
