"""Validated configuration: one tree of plain values, read from TOML, in SI units."""

import difflib
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxsat.errors import InputError

Method = Literal["standard", "direct", "triangle", "quadratic", "map"]
RailSetting = Literal["auto", "none"] | float


_Factor = Annotated[float, Field(gt=0)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Noise(_Section):
    """Noise of the sensors as densities, with what no model of them says (scale, axes), and how still a rest is.

    Chosen by the position RMSE of `standard` on recordings that do not saturate: the 14 such PyShoe trials and the
    gaitmap walk (`CHANGELOG.md`).
    """

    gyr_density: float = Field(default=1e-3, gt=0, description="angular-rate noise density (rad/s/√Hz)")
    acc_density: float = Field(default=1e-3, gt=0, description="specific-force noise density (m/s²/√Hz)")
    axes: tuple[_Factor, ...] = Field(
        default=(1.0,) * 6,
        min_length=6,
        max_length=6,
        description="density of each channel, gyr_x to acc_z, over that of its sensor",
    )
    change: float = Field(
        default=0.03,
        ge=0,
        description="sd of a value as a share of its sensor's change between neighbouring samples",
    )
    rest_velocity_sd: float = Field(
        default=0.02, gt=0, description="sd of the velocity of a resting sensor (m/s)"
    )
    rest_steady: float = Field(
        default=0.2,
        ge=0,
        description="that velocity stays alike for so long (s), which counts in what sd are claimed; 0: white",
    )
    initial_tilt_sd: float = Field(
        default=0.005, gt=0, description="sd of the initial tilt, mostly accelerometer bias (rad)"
    )

    @property
    def densities(self) -> list[float]:
        """Of the six channels (rad/s/√Hz, m/s²/√Hz)."""
        sensors = [self.gyr_density] * 3 + [self.acc_density] * 3
        return [density * factor for density, factor in zip(sensors, self.axes, strict=True)]

    @property
    def changes(self) -> list[float]:
        """`change` of the six channels."""
        return [self.change * factor for factor in self.axes]


class Rests(_Section):
    """When the sensor stands still."""

    detector: Literal["shoe", "ared", "amvd", "mag"] = "shoe"
    threshold: Literal["auto"] | float = "auto"
    window: float = Field(default=0.04, gt=0, description="length of the detector's window (s)")
    min_duration: float = Field(default=0.05, ge=0, description="shorter rests are dropped (s)")


class Rails(_Section):
    """Saturation limits: found in the recording, absent, or given as one magnitude for the three axes."""

    gyr: RailSetting = Field(default="auto", description="gyroscope limit (rad/s)")
    acc: RailSetting = Field(default="auto", description="accelerometer limit (m/s²)")


class Saturation(_Section):
    """How saturated samples are filled."""

    gyr_bound: float = Field(
        default=10.0, gt=0, description="most that a true rate exceeds its rail, δ_b (rad/s)"
    )
    acc_bound: float = Field(default=100.0, gt=0, description="the same for specific force (m/s²)")
    segments: Literal["parallel", "sequential"] = "parallel"
    sweeps: Literal["auto"] | Annotated[int, Field(ge=1, le=20)] = Field(
        default="auto", description="passes over all segments when they are parallel; auto: 2, with map 3"
    )
    free_peak_time: bool = Field(
        default=False, description="search the peak time of a triangle or parabola too"
    )
    solver: Literal["gauss_newton", "projected_gradient"] = Field(
        default="gauss_newton", description="gauss_newton or projected_gradient"
    )
    tolerance: float = Field(
        default=1e-2, gt=0, description="largest accepted optimality residual (scaled, per variable)"
    )
    max_iterations: int = Field(default=1000, ge=1)
    # On the PyShoe walks of the list `clip`, clipped at 350, 250 and 200 °/s, half of the gaps lost at least 30 to
    # 100 % more or less than a prior of one channel says.
    prior_share: float = Field(
        default=0.3, gt=0, description="least sd of what a gap lost, over what the prior of `map` says of it"
    )
    prior_width: float = Field(
        default=0.5, gt=0, description="root mean square of what gaps lose, in rails, as `map` expects it"
    )

    def passes(self, method: str) -> int:
        """`sweeps` in numbers; the first of `map` teaches the others what gaps lose."""
        return {"map": 3}.get(method, 2) if self.sweeps == "auto" else self.sweeps


class Height(_Section):
    """What is known of the height of rests, relative to the first one."""

    mode: Literal["auto", "off", "zero", "nonnegative"] = Field(
        default="auto",
        description="rests at one height: assumed where the recording agrees (auto), never (off) or always (zero); "
        "or none below the first (nonnegative)",
    )
    sd: float = Field(default=0.01, gt=0, description="sd of the height of a rest on level ground (m)")


class Smoother(_Section):
    """The whole-trial smoother."""

    relinearisations: int = Field(default=1, ge=0, le=20, description="Gauss-Newton steps after the first")
    gyr_offset: Literal["rests", "none"] = Field(
        default="rests", description="constant rate to remove: what it reads at rests, or none"
    )
    gyr_bias_sd: float = Field(
        default=0.0, ge=0, description="prior sd of a rate bias that motions tell (rad/s); 0: none"
    )
    acc_bias_sd: float = Field(
        default=0.05, ge=0, description="prior sd of the accelerometer's bias (m/s²); 0: none"
    )
    lever_sd: float = Field(
        default=0.1,
        ge=0,
        description="prior sd of each axis of the lever from the sensor to the point that stands still, and of how "
        "far that point wanders (m); 0: none",
    )

    @property
    def constants_sd(self) -> list[float]:
        """Prior sd of what is constant in a recording (rad/s, m/s², m)."""
        return [self.gyr_bias_sd] * 3 + [self.acc_bias_sd] * 3 + [self.lever_sd] * 3


class Orientation(_Section):
    """`jaxsat orientation`: attitude alone, from gyroscope and accelerometer."""

    estimate: Literal["gyro", "accel", "gyro_accel", "pi", "smoothed"] = "smoothed"
    update: Literal["exact", "comp", "imp"] = "exact"
    direction: Literal["mean", "unit"] = Field(
        default="mean", description="what is called up: specific force over g, or its direction"
    )
    gains: Literal["given", "good_gain"] = Field(
        default="given", description="kp and ki as given here, or as the Good Gain method proposes them"
    )
    # By gradient on the BROAD trials with breaks (results/orientation); ki half of the optimum: inclination is as
    # good, and heading, which that loss does not see, better.
    kp: float = Field(default=0.5, ge=0, description="proportional gain (1/s)")
    ki: float = Field(default=0.005, ge=0, description="integral gain (1/s²)")
    tau: float = Field(default=2.5, ge=0, description="low-pass on the specific force (s)")
    gate: Literal["none"] | Annotated[float, Field(gt=0)] = Field(
        default="none", description="how far |a| may be from g before it is not believed (m/s²)"
    )
    limit: float = Field(default=0.05, gt=0, description="largest rate that the integral term adds (rad/s)")
    offset: Literal["rests", "integral"] = Field(
        default="rests",
        description="what follows the gyroscope's offset: its reading at rests too, or the integral term alone",
    )
    fill: Literal["interpolate", "none"] = Field(
        default="interpolate", description="what becomes of saturated rates"
    )


class Periodic(_Section):
    """Periodic motion (`jaxsat periodic`)."""

    method: Literal["least_squares", "recursive", "bmflc", "wflc"] = "least_squares"
    band: Literal["auto"] | tuple[float, float] = Field(
        default="auto", description="lowest and highest frequency of the motion (Hz)"
    )
    sensor_lowpass: Literal["none"] | float = Field(
        default="none", description="cut-off of the first-order filter in the sensor (Hz)"
    )
    highpass: Literal["auto"] | float = Field(
        default="auto",
        description="cut-off before the combiners of the paper (Hz); auto: half of the band's low",
    )
    highpass_order: int = Field(default=4, ge=1, le=8)
    frequencies: int = Field(
        default=9, ge=1, le=99, description="across the band, of recursive, bmflc and wflc"
    )
    mu: float = Field(default=0.005, gt=0, lt=1, description="LMS gain of the amplitudes")
    mu_frequency: float = Field(
        default=1e-5, ge=0, description="LMS gain of the frequency of wflc, its input scaled to 1"
    )


class Config(_Section):
    """Everything that `estimate` can be told; unknown keys are errors."""

    method: Method = "map"
    gravity: Literal["auto"] | float = Field(
        default="auto", description="magnitude (m/s²); auto: |a| over the first rest"
    )
    noise: Noise = Noise()
    rests: Rests = Rests()
    rails: Rails = Rails()
    saturation: Saturation = Saturation()
    height: Height = Height()
    smoother: Smoother = Smoother()
    orientation: Orientation = Orientation()
    periodic: Periodic = Periodic()


def load_config(path: Path | None = None, **overrides: Any) -> Config:
    """Configuration from a TOML file, with dotted overrides (`{"rails.gyr": 5.2}`) on top.

    Raises `InputError` that names the file, the key, and for an unknown key the nearest known one.
    """
    tree: dict[str, Any] = {}
    where = "configuration"
    if path is not None:
        where = str(path)
        try:
            tree = tomllib.loads(Path(path).read_text())
        except OSError as error:
            raise InputError(
                f"{path}: cannot read the configuration ({error.strerror}); check the path."
            ) from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: not valid TOML ({error}); correct that line.") from None
    for key, value in overrides.items():
        node, *parents, leaf = [tree, *key.split(".")]
        for part in parents:
            node = node.setdefault(part, {})
        node[leaf] = value
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        raise InputError(f"{where}: {_sentence(error)}") from None


def config_toml(config: Config) -> str:
    """A configuration as TOML that `load_config` reads: its noise, and whatever else is not the default."""
    tree = config.model_dump(exclude_defaults=True) | {"noise": config.noise.model_dump()}
    plain = {key: value for key, value in tree.items() if not isinstance(value, dict)}
    sections = {key: value for key, value in tree.items() if isinstance(value, dict)}
    blocks = [("", plain), *((f"[{name}]\n", section) for name, section in sections.items())]
    # JSON writes these values (texts, numbers, truths, pairs) as TOML does.
    return "\n".join(
        head + "".join(f"{key} = {json.dumps(value)}\n" for key, value in block.items())
        for head, block in blocks
        if block
    )


def _known_keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        yield prefix + name
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _known_keys(field.annotation, f"{prefix}{name}.")


def _sentence(error: ValidationError) -> str:
    first = error.errors()[0]
    parts = [str(part) for part in first["loc"]]
    known = list(_known_keys(Config))
    if first["type"] == "extra_forbidden":
        key = ".".join(parts)
        by_leaf = {name.rsplit(".", 1)[-1]: name for name in known}
        near = difflib.get_close_matches(key, known, 1, 0.5)
        near = near or [by_leaf[m] for m in difflib.get_close_matches(parts[-1], by_leaf, 1, 0.5)]
        hint = f"; did you mean '{near[0]}'?" if near else f"; known keys are {', '.join(known)}."
        return f"unknown key '{key}'{hint}"
    # The location of a union ends with the name of the alternative that failed.
    key = max(
        (".".join(parts[:n]) for n in range(len(parts) + 1) if ".".join(parts[:n]) in known),
        key=len,
        default="",
    )
    said = [e["msg"] for e in error.errors() if ".".join(map(str, e["loc"])).startswith(key)]
    rest = [message.removeprefix("Input should be ") for message in said[1:]]
    return f"'{key}' is {first['input']!r}, but {' or '.join([said[0][0].lower() + said[0][1:], *rest])}."
