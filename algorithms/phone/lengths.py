"""Step length models (phone dissertation, eqs 3.10–3.16), and the fit of their constants to a known distance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from ..contract import AlgorithmError, FloatArray
from ..numerics.compiled import compiled
from ..parameters import meta
from .ring import F_MAX, F_MAX_LOW, F_MEAN, F_MEAN_ABS, F_MIN, F_MIN_LOW, F_PERIOD, F_VAR
from .steps import PhoneStepParams

MODELS = ("cadence", "static", "linear", "weinberg", "kim", "scarlett", "equal")
CADENCE, STATIC, LINEAR, WEINBERG, KIM, SCARLETT, EQUAL = range(len(MODELS))

FIELDS: list[tuple[Any, ...]] = [
    ("model", "i8"),
    ("length_k", "f8", (3,)),
    ("length_height", "f8"),
    ("cadence_s", "f8"),  # smoothed time of a step
]


class LengthParams(PhoneStepParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Detector of steps, and which model of their length."""

    length: Annotated[
        Literal["cadence", "static", "linear", "weinberg", "kim", "scarlett", "equal"],
        meta(
            "Model of a step's length: K·f; K·height; α f + β v + γ; K (max − min)^¼; K (mean |a|)^⅓; "
            "K (mean − min)/(max − min); K",
            source="phone dissertation, table 3.1; cadence: constant walk ratio (Sekiya et al. 1996)",
        ),
    ] = "cadence"
    length_k: Annotated[
        float,
        meta(
            "Constant K of the model; 0: the model's own (cadence 0.40 m·s, static 0.414, weinberg 0.41, "
            "kim 0.55, scarlett 1.5, equal 0.7 m)",
            source="phone dissertation, table 3.1",
            ge=0.0,
        ),
    ] = 0.0
    length_alpha: Annotated[float, meta("linear: α of the step frequency", "m·s", "ours")] = 0.39
    length_beta: Annotated[float, meta("linear: β of the variance of ‖f‖", "s⁴/m", "ours")] = 0.0
    length_gamma: Annotated[float, meta("linear: γ", "m", "ours")] = 0.0
    body_height_m: Annotated[float, meta("static: height of the person", "m", gt=0.5, lt=2.6)] = 1.7


_DEFAULT_K = {"cadence": 0.40, "static": 0.414, "weinberg": 0.41, "kim": 0.55, "scarlett": 1.5, "equal": 0.7}


def configure(s: Any, p: LengthParams) -> None:
    """Write the model and its constants into record ``s``."""
    s["model"] = MODELS.index(p.length)
    if p.length == "linear":
        s["length_k"][:] = p.length_alpha, p.length_beta, p.length_gamma
    else:
        s["length_k"][:] = p.length_k or _DEFAULT_K[p.length], 0.0, 0.0
    s["length_height"] = p.body_height_m


@compiled
def length_of(s: Any, f: Any) -> float:
    """Return the length (m) of a step with the features ``f`` (see :mod:`.ring`)."""
    k = s.length_k[0]
    period = f[F_PERIOD]
    if s.cadence_s == 0.0 or not 0.5 < period / s.cadence_s < 2.0:
        s.cadence_s = period
    s.cadence_s += 0.25 * (period - s.cadence_s)
    model = s.model
    if model == CADENCE:
        return k / s.cadence_s
    if model == STATIC:
        return k * s.length_height
    if model == LINEAR:
        return k / period + s.length_k[1] * f[F_VAR] + s.length_k[2]
    if model == WEINBERG:
        return k * (f[F_MAX_LOW] - f[F_MIN_LOW]) ** 0.25
    if model == KIM:
        return k * f[F_MEAN_ABS] ** (1.0 / 3.0)
    if model == SCARLETT:
        swing = f[F_MAX] - f[F_MIN]
        return k * (f[F_MEAN] - f[F_MIN]) / swing if swing > 0.0 else np.nan
    return k


def regressors(model: str, features: FloatArray, body_height_m: float = 1.7) -> FloatArray:
    """Return what a model's constants multiply, by step.

    Parameters
    ----------
    model : str
        One of :data:`MODELS`.
    features : ndarray
        Features of the steps as of :func:`.ring.features`, shape (n, 9).
    body_height_m : float
        Height of the person (m), for ``static``.

    Returns
    -------
    ndarray
        Shape (n, 3) for ``linear`` (f, v, 1), else (n, 1).
    """
    f = np.asarray(features, dtype=np.float64)
    one = np.ones(len(f))
    columns = {
        "cadence": (1 / f[:, F_PERIOD],),
        "static": (one * body_height_m,),
        "linear": (1 / f[:, F_PERIOD], f[:, F_VAR], one),
        "weinberg": ((f[:, F_MAX_LOW] - f[:, F_MIN_LOW]) ** 0.25,),
        "kim": (f[:, F_MEAN_ABS] ** (1 / 3),),
        "scarlett": ((f[:, F_MEAN] - f[:, F_MIN]) / np.maximum(f[:, F_MAX] - f[:, F_MIN], 1e-9),),
        "equal": (one,),
    }
    if model not in columns:
        raise AlgorithmError(f"no length model {model!r}; there are {', '.join(MODELS)}")
    return np.column_stack(columns[model])


def fit_lengths(
    model: str, walks: list[tuple[FloatArray, float]], body_height_m: float = 1.7
) -> Mapping[str, float]:
    """Fit a model's constants to walks of known length by least squares.

    Parameters
    ----------
    model : str
        One of :data:`MODELS`.
    walks : list of (ndarray, float)
        Features of a walk's steps, shape (n, 9), and the distance walked (m). One is enough for models of
        one constant; ``linear`` needs three walks of different pace.

    body_height_m : float
        Height of the person (m), for ``static``.

    Returns
    -------
    mapping of str to float
        Values for :class:`LengthParams` (``length_k``, or ``length_alpha``, ``length_beta``, ``length_gamma``).

    Raises
    ------
    AlgorithmError
        The walks do not determine the constants.
    """
    rows = np.array([regressors(model, f, body_height_m).sum(axis=0) for f, _ in walks])
    distances = np.array([d for _, d in walks])
    scale = np.abs(rows).max(axis=0) if len(rows) else np.zeros(1)
    if not len(rows) or np.any(scale == 0) or np.linalg.matrix_rank(rows / scale, 1e-3) < rows.shape[1]:
        raise AlgorithmError(
            f"length model {model}: {len(walks)} walks do not determine its {rows.shape[-1]} constants; "
            "give walks of different pace and known length"
        )
    coefficients = np.linalg.lstsq(rows / scale, distances, rcond=None)[0] / scale
    names = ("length_alpha", "length_beta", "length_gamma") if model == "linear" else ("length_k",)
    return dict(zip(names, coefficients.tolist(), strict=True))
