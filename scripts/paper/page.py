"""The board and the page: made from the tables that the experiments wrote."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxsat.studies.boards import Row

from .drawing import LABELS
from .trials import METHODS, SWEPT, Settings, settings

# The tables of the paper: the experiment, and the column that its error is in.
TABLES = {"table1": ("bar", "last"), "table2": ("straight", "last"), "table3": ("planar", "distance")}
WALKS = ("walk_saturated", "walk_clipped")
_ERRORS = {
    "last": "last position (m)",
    "norm": "position error norm (m²)",
    "distance": "start-stop distance (m)",
}
FIGURES = {
    "errors": "error",
    "path": "path",
    "filled": "the saturated signal, filled",
    "intervals": "coordinates of the end within some sd of the truth",
    "descent": "J along the search",
    "peaks": "how far off its peaks are",
}


_HEAD = """# The paper, reproduced

Q. K. Dang and Y. S. Suh, *Sensor Saturation Compensated Smoothing Algorithm for Inertial Sensor Based Motion
Tracking*, Sensors 2014, 14(5), 8167-8188: its tables and figures, by `python scripts/reproduce_paper.py`. All ratios
are in `board.md`.

The paper's recordings are not public, and it does not say enough of its simulation to repeat it; what can be compared
is the ratio of a compensated to the standard error. What was chosen stands with each experiment. `map` is not of the
paper. Simulations have no bias, scale error or misalignment. "Never clipped" is the standard smoother on the same
recording before it was clipped: what noise alone costs.
"""


def board(out: Path, done: Mapping[str, Settings]) -> Iterator[Row]:
    """Ratios of compensated to standard errors, with the paper's as goals; then what the paper does not have."""
    for metric, (name, column) in TABLES.items():
        if name in done:
            yield from _ratios(metric, _read(out, name), column, done[name]["paper"][column])
    if "straight_even" in done:
        rows = _read(out, "straight_even")
        yield from _ratios("table2_even", rows, "last", done["straight_even"]["paper"]["last"])
    paper = settings("walk")["paper"]["last"]
    if "walk" in done:
        yield from _ratios("walk", _read(out, "walk"), "last", paper)
    for name in (name for name in WALKS if name in done):
        for method, found in _read(out, name).groupby("method", sort=False):
            if method == "standard":
                continue
            ratio, rmse = (found[column].to_numpy() for column in ("last_ratio", "rmse_ratio"))
            note = (
                f"last position, aligned, against motion capture: median of {len(found)} trials, "
                f"{ratio.min():.2f} to {ratio.max():.2f}; RMSE, geometric mean {_mean(rmse):.2f}"
            )
            yield Row(
                f"{name}_{method}",
                float(np.median(ratio)),
                "1",
                "lower",
                _ratio(paper, str(method)),
                None,
                note,
            )
    for name in ("coverage", "coverage_drawn"):
        for row in _read(out, name).to_dict("records") if name in done else ():
            for column, what in _INTERVALS.items():
                for share in (50, 90):
                    value = row[f"{column}_{share}"]
                    note = f"{value:.0%} of {what} lie in their {share} % interval, {row['seeds']} seeds"
                    metric = f"{name}_{column}_{share}_{row['method']}"
                    yield Row(metric, abs(value - share / 100.0), "1", "lower", 0.05, None, note)
    took = [json.loads((out / name / "env.json").read_text()) for name in done]
    cpu = sum(each.get("cpu_seconds", np.nan) for each in took) / 60.0
    note = f"{len(done)} experiments in several runs that traced, some compiled, anew on shared cores; " + (
        f"processor time {cpu:.1f} min" if np.isfinite(cpu) else "processor time was not taken of all"
    )
    yield Row("paper_minutes", sum(each["seconds"] for each in took) / 60.0, "min", "lower", 10.0, None, note)


def _ratios(metric: str, rows: pd.DataFrame, column: str, paper: Mapping[str, float]) -> Iterator[Row]:
    standard = rows[rows["method"] == "standard"].iloc[0]
    for method in METHODS:
        row = rows[rows["method"] == method].iloc[0]
        low, middle, high = (float(row[f"{column}_ratio_{name}"]) for name in ("low", "median", "high"))
        note = (
            f"error over that of standard ({standard[f'{column}_median']:.4f} m), median of {row['seeds']} seeds, "
            f"{low:.4f} to {high:.4f} (5 to 95 %); goal: the paper's ratio"
        )
        yield Row(f"{metric}_{method}", middle, "1", "lower", _ratio(paper, method), None, note)


def _ratio(paper: Mapping[str, float], method: str) -> float:
    """The paper's; for `map`, which it does not have, its best."""
    ours = [paper[method]] if method in paper else [v for m, v in paper.items() if m != "standard"]
    return round(min(ours) / paper["standard"], 3)


def _mean(ratios: pd.Series | np.ndarray) -> float:
    return float(np.exp(np.log(ratios).mean()))


def _read(out: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(out / name / "table.csv")


def page(out: Path, done: Mapping[str, Settings]) -> str:
    """The page of all experiments: what the paper leaves open, its values beside ours, and the figures."""
    notes = out / "notes.md"
    parts = [_HEAD, *([notes.read_text()] if notes.exists() else [])]
    for name, chosen in done.items():
        parts.append(f"## {chosen['title']}\n")
        parts.append(f"{chosen['about'].strip()}\n")
        parts.append(_table(_read(out, name), chosen))
        folder = out / name
        for file in sorted(folder.glob("*.png"), key=lambda file: list(FIGURES).index(file.stem)):
            parts.append(f"![{chosen['title']}: {FIGURES[file.stem]}]({name}/{file.name})\n")
        parts.append(
            f"`{name}/table.csv`, `{name}/env.json`; `configs/paper/{name}.toml`; "
            f"`python scripts/reproduce_paper.py {name}`\n"
        )
    return "\n".join(parts)


def _table(rows: pd.DataFrame, chosen: Settings) -> str:
    """The table of an experiment for people."""
    if "order" in rows or "formula" in rows or "start" in rows or "solver" in rows:
        return _plain(rows)
    if "sweep" in chosen:
        return _sweep(rows)
    if "end_50" in rows:
        return _coverage(rows)
    if "trial" in rows:
        return _trials(rows)
    column = next(iter(chosen["paper"]))
    sensor, unit = ("gyr", "rad/s") if "gyr" in chosen["rails"] else ("acc", "m/s²")
    cells = []
    there = [method for method in LABELS if method in set(rows["method"])]
    for row in rows.set_index("method", drop=False).loc[there].to_dict("records"):
        method, paper = row["method"], chosen["paper"]
        cell: dict[str, Any] = {"": LABELS[method]}
        for name, values in paper.items():
            what = _ERRORS[name]
            cell[f"{what}, paper"] = _number(values.get(method))
            cell[f"{what}, ours"] = _spread(row, name)
        cell["ratio, paper"] = (
            _number(paper[column][method] / paper[column]["standard"]) if method in paper[column] else ""
        )
        cell["ratio, ours"] = _spread(row, f"{column}_ratio")
        cell[f"filled values, RMS error ({unit})"] = _number(row[f"fill_rmse_{sensor}_median"])
        cells.append(cell)
    found = rows.loc[rows["method"].isin(METHODS)]
    return _markdown(pd.DataFrame(cells)) + (
        f"\nMedians and 5 to 95 % over {int(found['seeds'].iloc[0])} seeds; {found['saturated'].median():g} values "
        f"saturate; {_converged(found)}\n"
    )


def _converged(rows: pd.DataFrame) -> str:
    """What share of the searches did, of the worst row."""
    least = float(np.min(rows["converged"]))
    if least == 1.0:
        return "every search converged."
    return f"at least {least:.1%} of the searches of each method converged."


def _sweep(rows: pd.DataFrame) -> str:
    """Some of its steps; all are in the file."""
    by = next(column for column in SWEPT if column in rows)
    what = {"gyr_rail": "gyroscope rail (rad/s)", "gyr_bound": "δ_b (rad/s)"}[by]
    steps = np.unique(rows[by])
    cells = []
    for step in steps[np.linspace(0, len(steps) - 1, min(8, len(steps))).round().astype(int)]:
        found = {row["method"]: row for row in rows.loc[rows[by] == step].to_dict("records")}
        cell = {what: _number(step), "saturated values": f"{found['standard']['saturated']:g}"}
        for method in ("standard", *METHODS):
            cell[LABELS[method]] = _number(found[method]["last_median"])
        cells.append(cell)
    return (
        f"Last-position error (m), medians over {int(rows['seeds'].iloc[0])} seeds, {len(cells)} of {len(steps)} "
        f"values:\n\n{_markdown(pd.DataFrame(cells))}\nWhere something saturates, "
        f"{_converged(rows.loc[rows['saturated'] > 0])}\n"
    )


_INTERVALS = {"fill": "filled values", "peak": "peaks", "end": "coordinates of the last position"}


def _coverage(rows: pd.DataFrame) -> str:
    cells = [
        {
            "": LABELS[row["method"]],
            "seeds": row["seeds"],
            **{
                f"{what} in their 50 and 90 % intervals": f"{row[f'{column}_50']:.0%}, {row[f'{column}_90']:.0%}"
                for column, what in _INTERVALS.items()
            },
            "last-position error (m), median": _number(row["error_median"]),
            "its sd (m), median": _number(row["sd_median"]),
        }
        for row in rows.to_dict("records")
    ]
    return _markdown(pd.DataFrame(cells))


def _trials(rows: pd.DataFrame) -> str:
    wide = rows.pivot(index="trial", columns="method", values="last").loc[
        :, list(dict.fromkeys(rows["method"]))
    ]
    wide = wide.rename(columns=LABELS).map(_number)
    ratio = rows.groupby("method", sort=False).agg(
        last=("last_ratio", "median"), worst=("last_ratio", "max"), rmse=("rmse_ratio", _mean)
    )
    ratio.index = pd.Index([LABELS[str(m)] for m in ratio.index], name="")
    ratio.columns = pd.Index(
        ["median ratio of last positions", "worst ratio", "geometric mean of the ratios of RMSE"]
    )
    each, together = _markdown(wide.reset_index()), _markdown(ratio.map(_number).reset_index())
    return f"Last-position error (m):\n\n{each}\n{together}"


def _plain(rows: pd.DataFrame) -> str:
    """What each group came to."""
    if "order" in rows:
        cells = [
            {
                "": f"{LABELS[row['method']]}, {row['order']}",
                "last position (m)": _spread(row, "last"),
                "J of the recording": _spread(row, "cost"),
                "time (s)": _spread(row, "seconds"),
            }
            for row in rows.to_dict("records")
        ]
        return _markdown(pd.DataFrame(cells))
    if "start" in rows:
        groups = rows.groupby(["method", "start"], sort=False)
        cells = groups.agg(
            last=("last", "median"),
            cost=("cost", "median"),
            iterations=("iterations", "median"),
            away=("away", "median"),
        )
        names = [
            "last-position error (m)",
            "J",
            "iterations",
            "δ away from that of the first start, RMS (rad/s)",
        ]
        return _markdown(cells.set_axis(names, axis=1).map(_number).reset_index())
    if "solver" in rows:
        groups = rows.groupby(["method", "solver"], sort=False)
        cells = groups.agg(start=("cost", "first"), end=("best", "min"), evaluations=("evaluation", "max"))
        names = ["J at δ = 0", "least J", "evaluations until then"]
        return _markdown(cells.set_axis(names, axis=1).map(lambda x: f"{x:.7g}").reset_index())
    groups = rows.groupby("formula", sort=False)
    cells = groups.agg(usable=("usable", "mean"), fill=("fill_rmse_median", "median"))
    names = ["peaks inside the gap and above the rail", "RMS error in the gap (rad/s)"]
    return _markdown(cells.set_axis(names, axis=1).map(_number).reset_index())


def _spread(row: Mapping[Any, Any], column: str) -> str:
    low, middle, high = (row[f"{column}_{name}"] for name in ("low", "median", "high"))
    return f"{_number(middle)} ({_number(low)} to {_number(high)})"


def _number(value: float | None) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.3g}"


def _markdown(table: pd.DataFrame) -> str:
    lines = ["| " + " | ".join(map(str, table.columns)) + " |", "|" + "---|" * table.shape[1]]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in table.itertuples(index=False)]
    return "\n".join(lines) + "\n"
