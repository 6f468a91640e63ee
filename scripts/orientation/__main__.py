"""Make the tables that are asked for, and the board and the page of all."""

import argparse
import json
import tomllib
from importlib.metadata import version
from pathlib import Path

import pandas as pd

from jaxsat.config import Orientation
from jaxsat.studies.boards import write_board

from .board import board, page
from .broad import broad_table
from .clipped import clipped_table
from .moving import moving_table
from .static import static_table
from .tuning import tuning_table

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "orientation" / "board.toml"
TABLES = ("static", "moving", "tuning", "broad", "clipped")


def main() -> None:
    parser = argparse.ArgumentParser(description="Orientation against the paper, peers and motion capture")
    parser.add_argument("data", type=Path, help="folder with broad/ and xio/")
    parser.add_argument("--only", nargs="*", choices=TABLES, default=TABLES)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/orientation"))
    parser.add_argument(
        "--again", nargs="*", default=(), help="filters of broad.csv to run anew, not all", metavar="NAME"
    )
    arguments = parser.parse_args()
    c, out = tomllib.loads(CONFIG.read_text()), arguments.output
    out.mkdir(parents=True, exist_ok=True)
    makers = {
        "static": static_table,
        "moving": moving_table,
        "tuning": tuning_table,
        "clipped": clipped_table,
    }
    for name in (name for name in TABLES if name in arguments.only):
        if name == "broad":
            former = pd.read_csv(out / "broad.csv") if arguments.again else None
            table = broad_table(c, arguments.data, pd.read_csv(out / "tuning.csv"), arguments.again, former)
        else:
            table = makers[name](c, arguments.data)
        table.round(6).to_csv(out / f"{name}.csv", index=False)
    if not all((out / f"{name}.csv").exists() for name in TABLES):
        return
    tables = {name: pd.read_csv(out / f"{name}.csv") for name in TABLES}
    peers = {name: version(name) for name in ("ahrs", "vqf")}
    configuration = json.loads(Orientation().model_dump_json()) | {"board": c, "peers": peers}
    write_board(out / "board.json", board(tables), configuration)
    notes = out / "notes.md"
    (out / "README.md").write_text(page(tables, notes.read_text() if notes.exists() else ""))


if __name__ == "__main__":
    main()
