"""The algorithms under test that campaign files can name: those that ship with Marsyard, and a user's own."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from algorithms.dimes import DimesEstimator, DimesOptions
from algorithms.hda import HdaEstimator, HdaOptions
from algorithms.hda.baselines import EssentialMatrixEstimator, SemiGlobalEstimator
from algorithms.interface import SiteEstimator, TargetTracker, VelocityEstimator
from algorithms.vtt import PURE_NCC, VisualTargetTracker, VttOptions, lucas_kanade_tracker

#: Where each velocity estimator's class is found; it is made without arguments, but for DIMES, which takes its options.
ESTIMATORS: Mapping[str, str] = {
    "dimes": "algorithms.dimes:DimesEstimator",
    "phase-correlation": "algorithms.baselines:PhaseCorrelationEstimator",
    "homography": "algorithms.baselines:HomographyEstimator",
}


def _pure_ncc(options: VttOptions) -> TargetTracker:
    """The paper's baseline: without scale, roll and stretch, whatever the options say of them."""
    return VisualTargetTracker(replace(options, scale=PURE_NCC.scale, roll=PURE_NCC.roll, affine=PURE_NCC.affine))


#: How each target tracker is made from its options; a user's own class is made without arguments.
TRACKERS: Mapping[str, Callable[[VttOptions], TargetTracker]] = {
    "vtt": VisualTargetTracker,
    "pure-ncc": _pure_ncc,
    "lucas-kanade": lucas_kanade_tracker,
}

#: How each estimator of landing sites is made from its options; a user's own class is made without arguments.
SITE_ESTIMATORS: Mapping[str, Callable[[HdaOptions], SiteEstimator]] = {
    "hda": HdaEstimator,
    "essential-matrix": EssentialMatrixEstimator,
    "semi-global": SemiGlobalEstimator,
}


def velocity_estimator(name: str, dimes: DimesOptions) -> VelocityEstimator:
    """The estimator of a name, or of a path ``module:Class`` to a class that implements `VelocityEstimator`.

    Raises ValueError where there is none.
    """
    check_estimator(name)
    kind = _class_at(ESTIMATORS.get(name, name))
    estimator: VelocityEstimator = DimesEstimator(dimes) if kind is DimesEstimator else kind()
    return estimator


def target_tracker(name: str, options: VttOptions) -> TargetTracker:
    """The tracker of a name, or of a path ``module:Class`` to a class that implements `TargetTracker`.

    Raises ValueError where there is none.
    """
    check_tracker(name)
    if name in TRACKERS:
        return TRACKERS[name](options)
    tracker: TargetTracker = _class_at(name)()
    return tracker


def site_estimator(name: str, options: HdaOptions) -> SiteEstimator:
    """The estimator of a name, or of a path ``module:Class`` to a class that implements `SiteEstimator`.

    Raises ValueError where there is none.
    """
    check_site_estimator(name)
    if name in SITE_ESTIMATORS:
        return SITE_ESTIMATORS[name](options)
    estimator: SiteEstimator = _class_at(name)()
    return estimator


def check_estimator(name: str) -> None:
    """Raises ValueError where there is no velocity estimator of this name; the message says what is allowed."""
    _check_known(name, ESTIMATORS)
    path = ESTIMATORS.get(name, name)
    if not hasattr(_class_at(path), "estimate"):
        raise ValueError(f"'{path}' is no velocity estimator: it has no method 'estimate'")


def check_tracker(name: str) -> None:
    """Raises ValueError where there is no target tracker of this name; the message says what is allowed."""
    _check_known(name, TRACKERS)
    if name in TRACKERS:
        return
    missing = [part for part in ("designate", "aim", "update", "clear", "state") if not hasattr(_class_at(name), part)]
    if missing:
        raise ValueError(f"'{name}' is no target tracker: it has no {', '.join(missing)}")


def check_site_estimator(name: str) -> None:
    """Raises ValueError where there is no estimator of landing sites of this name; the message says what is allowed."""
    _check_known(name, SITE_ESTIMATORS)
    if name not in SITE_ESTIMATORS and not hasattr(_class_at(name), "estimate"):
        raise ValueError(f"'{name}' is no estimator of landing sites: it has no method 'estimate'")


def _check_known(name: str, known: Mapping[str, Any]) -> None:
    if ":" in name or name in known:
        return
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    allowed = ", ".join(known)
    raise ValueError(f"unknown algorithm '{name}'{hint}; allowed: {allowed}, or your own as 'module:Class'")


def _class_at(path: str) -> Any:
    module, _, kind = path.partition(":")
    try:
        return getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"no algorithm at '{path}': {error}") from error
