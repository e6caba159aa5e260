"""An identified drag as files: configuration keys and JSON. It computes nothing."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from haltere._version import __version__
from haltere.flight.writing import whole_files
from haltere.identify.autopilots import ardupilot_parameters, parameter_sd, px4_parameters, remarks
from haltere.identify.drag import DragIdentification
from haltere.identify.forms import FORMS
from haltere.identify.projection import Projection

__all__ = ["document", "keys", "to_toml", "write"]


def keys(d: DragIdentification) -> dict[str, float]:
    """Configuration keys of haltere's own drag model, 1 sigma relative as it takes them; what the flights do not tell is left out.

    Navigator lets the linear drag follow the rotor speeds where a log has them: then µ is that of the model by rotor speed, in hover.
    """
    values, sd = d.own
    out = {"drag.mu": float(values[0]), "drag.mu_sd": float(sd[0] / values[0])}
    if values[1] > 0.0:
        out |= {"drag.c": float(values[1]), "drag.c_sd": float(sd[1] / values[1])}
    return out


def _model(d: DragIdentification, p: Projection) -> dict[str, Any]:
    names = FORMS[p.form].names
    sd = d.sd(p)
    return {
        **{n: float(v) for n, v in zip(names, p.values, strict=True)},
        **{f"{n}_sd": float(v) for n, v in zip(names, sd, strict=True)},
        "covariance": p.covariance.tolist(),
        "misfit": p.misfit,
        "model": FORMS[p.form].said,
    }


def document(d: DragIdentification) -> dict[str, Any]:
    """Everything of an identification but its samples, for JSON, in SI; wind is where it blows to."""
    best = min(f.bic for f in d.fits.values())
    return {
        "haltere": __version__,
        "flights": [m.name for m in d.motions],
        "refused": d.refused or None,
        "models": {
            form: {
                **{n: float(v) for n, v in zip(FORMS[form].names, f.values, strict=True)},
                **{f"{n}_sd": float(v) for n, v in zip(FORMS[form].names, f.sd, strict=True)},
                "model": FORMS[form].said,
                "bic": f.bic,
                "bic_above_best": f.bic - best,
                "converged": f.converged,
                "inflation": f.inflation,
                "still_air": d.still[form].tolist(),
            }
            for form, f in d.fits.items()
        },
        "base": d.base.form,
        "linear_drag_relative_sd": d.base.log_sd,
        "drag_at_5_m_s": dict(zip(("value", "sd"), d.drag_at, strict=True)),
        "haltere_drag": _model(d, d.haltere),
        "keys": {} if d.refused else keys(d),
        "px4": None if d.refused else px4_parameters(d),
        "px4_sd": None if d.refused else parameter_sd(d, "px4"),
        "ardupilot": None if d.refused else ardupilot_parameters(d),
        "ardupilot_sd": None if d.refused else parameter_sd(d, "ardupilot"),
        "density": {"mean": d.density, "relative_sd": d.density_sd},
        "force_sd": d.force_sd,
        "winds": [
            {
                "flight": m.name,
                "seconds": float(part.samples.t[-1] - part.samples.t[0]),
                "windows": len(part.samples.t),
                "wind_n": float(part.wind[0]), "wind_e": float(part.wind[1]),
                "sd_wind_n": float(sd[-2]), "sd_wind_e": float(sd[-1]),
                "offset_x": float(part.rest[0]), "offset_y": float(part.rest[1]),
                "sd_offset_x": float(sd[0]), "sd_offset_y": float(sd[1]),
                "gust": float(part.sizes[0]), "gust_time": float(part.sizes[1]),
                "left": float(part.sizes[2]), "left_time": float(part.sizes[3]), "noise": float(part.sizes[4]),
            }
            for m, part, sd in ((m, d.base.parts[k], d.base.part_sd(k)) for k, m in enumerate(d.motions))
        ],
        "remarks": [] if d.refused else remarks(d),
        "notes": list(d.notes),
    }  # fmt: skip


def to_toml(d: DragIdentification) -> str:
    """Configuration keys as a file that ``haltere run LOG --config`` takes."""
    import tomli_w

    table = {key.partition(".")[2]: value for key, value in keys(d).items() if math.isfinite(value)}
    first = f"# Drag of {d.name} by haltere {__version__}: haltere run LOG --config drag.toml\n"
    return first.replace("\r", " ") + tomli_w.dumps({"drag": table})


def write(d: DragIdentification, folder: str | Path, extra: Mapping[str, str] | None = None) -> Path:
    """Write ``drag.json``, ``drag.toml`` (not where it is refused) and further texts by name, whole or not at all.

    Raises
    ------
    HaltereError
        The folder cannot be written.
    """
    folder = Path(folder)
    texts = {"drag.json": json.dumps(document(d), indent=1, allow_nan=False, ensure_ascii=False) + "\n", **(extra or {})}
    if not d.refused:
        texts["drag.toml"] = to_toml(d)
    with whole_files(folder, "drag.json", ["drag.toml"] if d.refused else []) as work:
        for name, text in texts.items():
            (work / name).write_text(text, encoding="utf-8")
    return folder
