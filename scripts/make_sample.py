"""Make the recording that ships with the package, from gaitmap's example walk (MIT licence).

Usage: python scripts/make_sample.py [FOLDER of the gaitmap recording]
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from jaxsat.signals.readers import read
from jaxsat.signals.recording import CHANNELS
from jaxsat.studies.metrics import load_gaitmap_truth

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "jaxsat" / "sample"
# The sensor sits on the instep, between these three markers of the left foot.
MARKERS = ("L_FCC", "L_TOE", "L_FM5")


def main(source: Path) -> None:
    recording = read(source / "imu_sample_not_rotated.csv", format="gaitmap", sensor="left_sensor")
    walk = pd.DataFrame(recording.signal.astype(np.float32), columns=list(CHANNELS))
    walk.insert(0, "time", recording.time)
    walk.to_parquet(SAMPLE / "walk.parquet", index=False, compression="zstd")

    time, position = load_gaitmap_truth(source / "mocap_sample.csv", MARKERS)
    truth = pd.DataFrame(position.astype(np.float32), columns=["pos_x", "pos_y", "pos_z"])
    truth.insert(0, "time", time)
    truth.to_parquet(SAMPLE / "walk_truth.parquet", index=False, compression="zstd")

    # Its licence file also holds the AGPL of a sibling package, of which nothing is used here.
    licence = (source / "LICENSE").read_text()
    (SAMPLE / "LICENSE").write_text(licence[licence.index("MIT License") :].rstrip() + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT.parent / "shared" / "data" / "gaitmap")
