"""Does noise that `jaxsat tune` learns help where it was not learned?

    python scripts/tune_noise.py ../shared/data [-o results/tuning]

Learned from the PyShoe walks of the split `clip`, which do not saturate, rests as given: by the likelihood of their
rests, and by their position error against Vicon. Scored is the standard smoother on these, on the split `other`,
which hardly saturates, and on `saturated`. Writes likelihood.toml, truth.toml, board.json, board.md and env.json.
"""

import argparse
import tomllib
from pathlib import Path

import numpy as np

from jaxsat.cli.shared import use_compilation_cache
from jaxsat.config import Config, config_toml
from jaxsat.pipeline import estimate
from jaxsat.present.text import tuning_text
from jaxsat.signals.readers import read
from jaxsat.studies.boards import Row, write_board
from jaxsat.studies.metrics import load_pyshoe_truth, position_rmse
from jaxsat.studies.tuning import noise_trial, tune_noise

TRAIN, TEST = "clip", ("clip", "other", "saturated")
STANDARD = Config(method="standard")


def errors(folder: Path, names: list[str], config: Config) -> list[tuple[float, float]]:
    """Position RMSE of each trial: of all axes, and horizontally (m)."""
    found = []
    for name in names:
        recording = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        _, truth = load_pyshoe_truth(folder / f"{name}.mat", at=recording.time)
        position = estimate(recording, config).trajectory.position
        found.append((position_rmse(position, truth), position_rmse(position, truth, axes=2)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Noise learned from recordings")
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/tuning"))
    arguments = parser.parse_args()
    use_compilation_cache()
    folder = arguments.data / "pyshoe"
    splits = tomllib.loads((folder / "splits.toml").read_text())
    paths = [folder / f"{name}.mat" for name in splits[TRAIN]]
    arguments.output.mkdir(parents=True, exist_ok=True)
    recordings = [read(path, rest_column="zv_shoe_opt") for path in paths]
    trials = [
        noise_trial(recording, STANDARD, load_pyshoe_truth(path))
        for recording, path in zip(recordings, paths, strict=True)
    ]
    noises = {"default": STANDARD.noise}
    for name in ("likelihood", "truth"):
        tuned = tune_noise(
            trials,
            STANDARD.noise,
            against_truth=name == "truth",
            report=lambda done, total, name=name: print(name, done, total, flush=True),
        )
        noise, loss = (STANDARD.noise, tuned.noise), (tuned.before, tuned.after)
        text = tuning_text(noise, loss, name == "truth", [path.stem for path in paths])
        print(text, flush=True)
        head = "".join(f"# {line}\n" for line in text.splitlines())
        toml = config_toml(STANDARD.model_copy(update={"noise": tuned.noise}))
        (arguments.output / f"{name}.toml").write_text(f"{head}\n{toml}")
        noises[name] = tuned.noise
    rows = []
    for split in TEST:
        note = "learned from" if split == TRAIN else "not learned from"
        means = {}
        for name, noise in noises.items():
            found = errors(folder, splits[split], STANDARD.model_copy(update={"noise": noise}))
            means[name] = np.mean(found, axis=0)
            for axes, mean, given in zip(("3d", "2d"), means[name], means["default"], strict=True):
                what = f"mean position RMSE of standard over {len(found)} trials, {note}"
                baseline = None if name == "default" else float(given)
                metric = f"{split}_{axes}_{name}"
                rows.append(Row(metric, float(mean), "m", "lower", None, baseline, what))
                print(metric, f"{mean:.4f}", flush=True)
    configuration = {
        "noise": {name: one.model_dump() for name, one in noises.items()},
        "train": splits[TRAIN],
    }
    write_board(arguments.output / "board.json", rows, configuration)


if __name__ == "__main__":
    main()
