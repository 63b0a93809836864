"""Many problems on many machines: a function, a list of cases, and a file that gets a row for each.

* `run`: calls the function on every case that the file does not hold yet, here, in processes of this machine, or on any
  executor of `concurrent.futures`, that of a Dask cluster included; rows are on the disk as soon as they are there.
* `read`: the rows of such a file.

What was stopped, by whomever and wherever, goes on when it is called again.
"""

from jaxhom.sweeps.row_files import read
from jaxhom.sweeps.runs import run

__all__ = ["read", "run"]
