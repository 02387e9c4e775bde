"""How far each number can plausibly be off before anything is measured: one sigma, in its own unit.

The table's: what cheap arms are made to and published identifications of them find (some mm, a degree). The causes': a
conductive-plastic potentiometer's data sheet (linearity 0.5 to 1 %, of which a part is scale), gears of hobby servos
(backlash up to a degree), and compliance that lets a
joint droop half a degree under the weight of a link of 0.25 m. A prior
pulls at most as strongly as one measurement of that sigma; with tens of poses the data override it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.identify.model import Model

#: Kind of parameter -> sigma of what it is off; base and tool are not known at all.
SIGMA: dict[str, float] = {
    "base": np.inf,
    "tool": np.inf,
    "offset": np.deg2rad(3.0),
    "d": 0.01,
    "a": 0.01,
    "alpha": np.deg2rad(2.0),
    "beta": np.deg2rad(2.0),
    "gain": 0.01,
    "wave": np.deg2rad(0.5),
    "ripple": np.deg2rad(0.1),
    "backlash": np.deg2rad(1.0),
    "slack": np.deg2rad(1.0),
    "sag": np.deg2rad(0.5) / 0.25,
}


def prior_sigma(model: Model, named: Mapping[str, float] | None = None) -> Array:
    """Return the prior sigma (P,) of every parameter.

    Args:
        model: the arm with its parameters.
        named: sigma by name of a parameter ("a2") or a kind ("alpha"), instead of those of SIGMA; 0 keeps it as it is.

    Raises:
        InputError: an unknown name, or a sigma below zero.
    """
    named = named or {}
    known = {*SIGMA, *model.names}
    for name, sigma in named.items():
        if name not in known:
            raise InputError(
                f"prior of {name!r}: no such parameter; kinds are {', '.join(SIGMA)}; names are such as a2"
            )
        if not sigma >= 0:
            raise InputError(f"prior of {name!r}: sigma is {sigma}; it must be 0 or more")
    return np.array([named.get(p.name, named.get(p.kind, SIGMA[p.kind])) for p in model.parameters])
