"""The world of several processes, `lemniscate.system.processes`, by its short name."""

from lemniscate.system.processes import Processes as Processes
from lemniscate.system.processes import together as together
