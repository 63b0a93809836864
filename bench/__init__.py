"""The experiments of Boularias and Chaib-draa (2010), section VI, and questions that the paper could not ask.

`python -m bench.reproduce table1 | figure1 | questions` computes rows, `python -m bench.report` turns rows into tables,
figures and words. The flow of a sweep, one module each:

    settings  which problems: domain, demonstrations, options; `problems` draws them, `methods` learns from them
    sweep     runs settings x methods in batches of draws, appends one row per draw (`rows`), resumes
    summaries means over draws with confidence intervals
    report    reads rows only: `comparison` with the paper in words, `tables`, `figures`

`python -m bench.speed similarity | lpal | planning` measures speed next to other solvers, from bottom to top:

    processes        the protocol of whoever is measured, in a process with a time limit
    ours             this library under that protocol; `lp_peers` and `planning_peers` the others, which get
                     `linear_programs` and `models` in their own form
    contest          rows of us and of the peers on one instance (`instances`)
    X_speed          draws instances, judges whoever solved them by one certificate
    speed_report     makes tables and figures of the rows alone
"""

import os

# Before NumPy is imported. The host's solvers factorise narrow bands, and sweeps keep every core busy: the threads of
# OpenBLAS would only wait for one another (5 s instead of 0.05 for an LPAL on a 32 x 32 grid).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
