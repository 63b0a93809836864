"""What the sweeps of learners, guarantees and queries say, in tables, figures and words, from rows alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bench import tables
from bench.figures import domain_name, draw_curve, panels_of, pick, with_legend
from bench.guarantees import LEAST, TRUE, WORST
from bench.learners import FED_WITH_NOTHING
from bench.queries import ROUNDS
from bench.rows import Row
from bench.settings import QUESTIONS_PER_ROUND
from bench.summaries import frame, grouped
from jaxhom.plotting import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILLION

LEARNERS_NOTE = """Percent of the expert's reward per step, in trials of the setting's length. What stands behind the
comma is whose feature expectations a learner was fed with; "max. causal entropy" and "inverse LP" alone were fed with
the demonstrations themselves. Weights are non-negative everywhere but in "projection", where they are free. Policies
are greedy for the weights that were found, but for "soft", projections and MWAL, whose theories promise a random one;
these two ran for up to 100 rounds. On the grid with wrong features, regions have four times the side and are shifted by
a cell; no weights make the true reward of them. A lake has 64 or 256 cells, and its features are its goal, its holes,
and tiles of 2 x 2 cells.

The rows "uniform", "best for equal weights" and "LPAL, zeros" are fed with no demonstration at all. The best method of
each kind, by setting:"""
GUARANTEES_NOTE = """Losses and bounds per step, in the units of the true reward; on tracks in weights of sum 1. The
bound at the true weights is what is lost at most against an expert with that reward who agrees with the demonstrations,
and may do anything elsewhere; the bound over all weights supposes the worst reward whose weights have the same sum."""
QUERIES_NOTE = """Percent of the expert's reward per step after each round, learned by Algorithm 1. A round is 20 single
states (5 on the small lake), or one more demonstration, which has 20 steps on racetrack (a), 40 on (b) and on the small
lake, 50 on grids and 80 on the large lake: "demonstrations" are told more on every domain but racetrack (a)."""
_CURVES = {
    "visits_entropy": ("visits times entropy", VERMILLION, "o", "-"),
    "visits": ("visits", ORANGE, "^", "-"),
    "bound": ("contribution to the bound", PURPLE, "D", "--"),
    "random states": ("random states", BLUE, "s", ":"),
    "demonstrations": ("more demonstrations", GREEN, "v", "-."),
}
_LOSSES = {
    (f"Algorithm 1, {TRUE}", "loss_bound"): ("Algorithm 1: true loss", BLACK, "x", ":"),
    (f"Algorithm 1, {TRUE}", "certificate"): ("bound at the true weights", VERMILLION, "o", "-"),
    (f"Algorithm 1, {WORST}", "certificate"): ("bound over all weights", ORANGE, "^", "--"),
    (f"robust policy, {WORST}", "certificate"): ("robust policy: bound over all weights", BLUE, "s", "-"),
    (f"max. causal entropy, {TRUE}", "certificate"): ("max. causal entropy: at the true weights", GREEN, "v", "-."),
}
_LEAST_SHOWN = 1e-4  # loss per step, on a logarithmic scale
_KINDS = {
    "no demonstration": tuple(FED_WITH_NOTHING),
    "generalization": ("k-NN", "Algorithm 1"),
    "max. causal entropy": ("max. causal entropy",),
    "LPAL": ("LPAL, Algorithm 1", "LPAL, Monte Carlo"),
    "projection, MWAL": (
        "projection, Algorithm 1",
        "projection, Monte Carlo",
        "MWAL, Algorithm 1",
        "MWAL, Monte Carlo",
    ),
    "inverse LP": ("inverse LP", "inverse LP, Algorithm 1"),
}


def learners_table(lines: pd.DataFrame) -> str:
    """For every setting and kind of method, the best one's percent of the expert, half its interval, and its name."""
    lines = pick(lines, metric="ratio")
    rows = []
    for (domain, count), here in _settings(lines):
        best = {kind: _best(here, names) for kind, names in _KINDS.items()}
        top = max((one[0] for one in best.values() if one), default=np.nan)
        rows.append([domain_name(domain), str(count), *(_cell(one, top) for one in best.values())])
    return tables.to_markdown(["domain", "demonstrations", *_KINDS], rows)


def _settings(lines: pd.DataFrame):
    """((domain, demonstrations), lines), domains as they first occur."""
    domains = list(dict.fromkeys(lines["domain"]))
    keyed = dict(iter(grouped(lines, "domain", "demonstrations")))  # a group has `keys` of its own
    return sorted(keyed.items(), key=lambda item: (domains.index(item[0][0]), item[0][1]))


def _best(lines: pd.DataFrame, names: Sequence[str]) -> tuple[float, float, str] | None:
    found = lines[lines["method"].isin(names)]
    if not len(found):
        return None
    line = found.loc[found["mean"].idxmax()]
    return 100 * line["mean"], 50 * (line["ci_high"] - line["ci_low"]), str(line["method"])


def _cell(one: tuple[float, float, str] | None, top: float) -> str:
    if one is None:
        return ""
    mean, half, name = one
    shown = f"{mean:.1f} ± {half:.1f}"
    tail = name.split(", ", 1)[-1] if ", " in name else name
    return f"{f'**{shown}**' if mean >= top - 0.05 else shown} ({tail})"


def guarantees_figure(lines: pd.DataFrame) -> Figure:
    """Bounds and true losses against the number of demonstrations, a panel per domain."""
    domains = list(dict.fromkeys(lines["domain"]))
    figure, panels = panels_of(1, len(domains), (3.3 * len(domains), 4.2))
    for domain, ax in zip(domains, panels.flat, strict=True):
        for (method, metric), style in _LOSSES.items():
            here = pick(lines, domain=domain, method=method, metric=metric)
            here = here[here["mean"] > _LEAST_SHOWN]
            if len(here):
                draw_curve(ax, here.assign(ci_low=here["ci_low"].clip(lower=_LEAST_SHOWN)), "demonstrations", *style)
        ax.set(yscale="log", xlabel="demonstrations", ylabel="loss per step" if ax is panels.flat[0] else "")
        ax.set_title(domain_name(domain), loc="left", fontsize="medium")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(color="#DDDDDD", linewidth=0.6)
    return with_legend(figure, columns=3)


def guarantees_words(rows: Sequence[Row], lines: pd.DataFrame) -> str:
    """Whether a bound was ever below the true loss, and the means per setting."""
    found = frame(rows)
    at_truth = found[found["method"].astype(str).str.endswith(TRUE)]
    excess = (at_truth["loss_bound"] - at_truth["certificate"]) / at_truth["expert_reward"]
    words = (
        f"In {len(at_truth)} rows with the true weights the bound is below the true loss in {(excess > 1e-7).sum()} "
        f"(largest excess {max(excess.max(), 0.0):.0e} of the expert's reward)."
    )
    columns = {name: key for key, (name, *_) in _LOSSES.items()}
    columns["no policy's worst loss is below"] = (f"robust policy, {LEAST}", "certificate")
    table = [
        [domain_name(domain), str(count), *(_number(here, *key) for key in columns.values())]
        for (domain, count), here in _settings(lines)
    ]
    return f"{words}\n\n{tables.to_markdown(['domain', 'demonstrations', *columns], table)}"


def _number(lines: pd.DataFrame, method: str, metric: str) -> str:
    here = pick(lines, method=method, metric=metric)
    return f"{here['mean'].iloc[0]:.3g}" if len(here) else ""


def queries_figure(lines: pd.DataFrame) -> Figure:
    """Percent of the expert against rounds, a panel per domain and number of demonstrations."""
    lines = pick(lines, metric="ratio")
    settings = _settings(lines)
    columns = -(-len(settings) // 2)
    figure, panels = panels_of(2, columns, (3.1 * columns, 6.4), sharey=True)
    for ax in panels.flat[len(settings) :]:
        ax.set_visible(False)
    for ((domain, count), here), ax in zip(settings, panels.T.flat, strict=False):
        for choice, style in _CURVES.items():
            draw_curve(ax, rounds_of(here, choice), "round", *style)
        ax.set(xlabel="round", ylabel="reward per step / expert's" if ax in panels[:, 0] else "")
        ax.set_title(f"{domain_name(domain)}\n{count} demonstrations", loc="left", fontsize="small")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(color="#DDDDDD", linewidth=0.6)
    return with_legend(figure, columns=5)


def rounds_of(lines: pd.DataFrame, choice: str) -> pd.DataFrame:
    """The lines of a way of choosing, by round; round 0 is before any question."""
    names = {f"{choice}, round {number}": number for number in range(1, ROUNDS + 1)} | {"no questions": 0}
    found = lines[lines["method"].isin(names)]
    return found.assign(round=found["method"].astype(str).map(names)).sort_values("round")


def queries_words(lines: pd.DataFrame) -> str:
    """Percent of the expert before any question, and after each round by way of choosing."""
    lines = pick(lines, metric="ratio")
    rows = []
    for (domain, count), here in _settings(lines):
        cells = [_rounds(rounds_of(here, choice)) for choice in _CURVES]
        before = 100 * pick(here, method="no questions")["mean"]
        asked = QUESTIONS_PER_ROUND.get(domain, 20)
        rows.append([domain_name(domain), str(count), str(asked), *(f"{x:.1f}" for x in before), *cells])
    heads = [style[0] for style in _CURVES.values()]
    return tables.to_markdown(["domain", "demonstrations", "questions a round", "before", *heads], rows)


def _rounds(lines: pd.DataFrame) -> str:
    return " / ".join(f"{100 * mean:.0f}" for mean in lines["mean"].iloc[1:])
