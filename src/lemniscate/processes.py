"""`lemniscate.system.processes` by the name that it had before it moved there, for programs that import it."""

from lemniscate.system.processes import Processes as Processes
from lemniscate.system.processes import together as together
