"""`jaxsat tune`: a file that `estimate --config` reads, and one sentence for what cannot be."""

from pathlib import Path

import pytest

from jaxsat.cli import main
from jaxsat.config import Noise, load_config


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Path:
    """Six strides; the truth lies beside the recording, and a split beside both."""
    path = tmp_path_factory.mktemp("tune") / "walk.csv"
    assert main(["simulate", "walk", "-o", str(path), "--duration", "9", "--rest"]) == 0
    path.with_name("splits.toml").write_text('train = ["walk"]\nempty = []\nlost = ["run"]\n')
    path.with_name("given.toml").write_text("[height]\nsd = 0.02\n")
    return path


def test_what_is_tuned_is_a_configuration(walk, tmp_path, capsys):
    out = tmp_path / "noise.toml"
    given = ["--config", str(walk.with_name("given.toml")), "--steps", "8", "--strict"]
    assert main(["tune", str(walk), "-o", str(out), *given]) == 0
    printed = capsys.readouterr()
    assert "tuned on 1 recording: walk.csv" in printed.out and printed.err == ""
    text, config = out.read_text(), load_config(out)
    assert text.startswith("# tuned on 1 recording: walk.csv\n") and "misfit of a rest" in text
    # The simulated rests are exact and its gyroscope is quieter than the default: both are noticed.
    assert config.noise.rest_velocity_sd < Noise().rest_velocity_sd
    assert config.noise.gyr_density < Noise().gyr_density
    assert config.height.sd == 0.02
    arguments = ["estimate", str(walk), "-o", str(tmp_path / "out"), "--method", "standard", "--quiet"]
    assert main([*arguments, "--config", str(out)]) == 0


def test_scales_of_the_prior_are_a_configuration_too(walk, tmp_path, capsys):
    out = tmp_path / "prior.toml"
    assert main(["tune", str(walk), "-o", str(out), "--prior", "--steps", "3", "--strict"]) == 0
    assert "misfit of a gap" in capsys.readouterr().out
    found, before = load_config(out), load_config()
    assert found.saturation.prior_share != before.saturation.prior_share
    assert found.saturation.prior_width != before.saturation.prior_width
    assert found.noise == before.noise


def test_a_split_and_the_truth_are_found(walk, tmp_path, capsys):
    out = tmp_path / "noise.toml"
    split = ["--split", str(walk.with_name("splits.toml")), "train"]
    # "walk" is two files: the truth and the splits have other stems.
    assert main(["tune", *split, "--truth", "-o", str(out), "--steps", "2"]) == 0
    assert "position RMSE" in capsys.readouterr().out and load_config(out).noise != Noise()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "no recording is given"),
        (["{walk}", "-o", "noise.json"], "end its name in .toml"),
        (["{walk}", "-o", "{folder}/none/noise.toml"], "choose another place"),
        (["{walk}", "--steps", "0"], "at least one recording and one step"),
        (["{folder}/splits.toml"], "splits.toml"),
        (["--split", "{folder}/splits.toml", "empty"], "no list of files under 'empty'"),
        (["--split", "{folder}/splits.toml", "test"], "choose one of train, empty, lost"),
        (["--split", "{folder}/splits.toml", "lost"], "'run' of 'lost' is 0 files"),
        (["--split", "{walk}", "train"], "no split can be read"),
        (["{folder}/walk_truth.csv", "--truth"], "no truth beside it"),
        (["{walk}", "--prior", "--truth"], "leave out --truth or --prior"),
    ],
)
def test_what_cannot_be_is_one_sentence(walk, tmp_path, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    arguments = [text.format(walk=walk, folder=walk.parent) for text in arguments]
    arguments += [] if "-o" in arguments else ["-o", "noise.toml"]
    assert main(["tune", *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1 and sentence in printed.err
    assert not list(tmp_path.iterdir())
