"""Section on the horizontal speed at touchdown, with and without steering by the estimated velocity."""

import numpy as np
import pandas as pd

from marsyard.reports import populations, rates
from marsyard.reports.blocks import distribution_block, rate_block
from marsyard.reports.column_values import numbers
from marsyard.reports.empty_cells import omit_empty_rows
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, create_section
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.wording import format_fraction, number, percent
from marsyard.scenarios.descent.parameters import TouchdownParameters


def landing_section(subject: Subject) -> Section | None:
    """Create the section on the horizontal speed at touchdown with and without steering by the estimated velocity."""
    landings = landing_rows(subject)
    if landings is None:
        return None
    return create_section(
        "landing",
        "Landing",
        "Horizontal speed at touchdown",
        distribution_block(
            "landing",
            {
                "with steering": rates.finite_values(landings, SPEED_CORRECTED),
                "without steering": rates.finite_values(landings, SPEED_UNCORRECTED),
            },
            ("horizontal speed at touchdown (m/s)", "fraction of landings above this speed"),
            "The same landings with steering by the reported velocity, and without. The lower curve is better.",
            complementary=True,
        ),
        rate_block(
            landing_fractions(landings),
            "Landings",
            "Effect of steering",
            "The intervals are two-sided Clopper-Pearson intervals, corrected for shared terrains.",
            data="fractions",
        ),
        create_speed_block(landings, subject),
    )


#: Columns of the horizontal speed at touchdown with and without steering.
SPEED_CORRECTED, SPEED_UNCORRECTED = "touchdown_speed_corrected_m_s", "touchdown_speed_uncorrected_m_s"
#: Minimum change of speed that counts as an improvement or a degradation, m/s.
MIN_SPEED_CHANGE_M_S = 1.0
#: Speeds above which the table gives the fraction of cases, m/s.
SPEEDS_M_S = (5.0, 10.0, 15.0, 20.0, 25.0)


def landing_rows(subject: Subject) -> pd.DataFrame | None:
    """Select the landings with both speeds; None without a landing."""
    speeds = np.column_stack([numbers(subject.frame, name) for name in (SPEED_CORRECTED, SPEED_UNCORRECTED)])
    landings = subject.frame[np.isfinite(speeds).all(axis=1)]
    return landings if len(landings) else None


def landing_fractions(landings: pd.DataFrame) -> dict[str, rates.CaseFraction]:
    """Compute fractions of landings with a lower and a higher speed, and of answers available before ignition."""
    change = numbers(landings, SPEED_CORRECTED) - numbers(landings, SPEED_UNCORRECTED)
    fractions = {
        f"slower by more than {MIN_SPEED_CHANGE_M_S:g} m/s": rates.fraction_of(
            change < -MIN_SPEED_CHANGE_M_S, landings
        ),
        f"faster by more than {MIN_SPEED_CHANGE_M_S:g} m/s": rates.fraction_of(change > MIN_SPEED_CHANGE_M_S, landings),
    }
    if populations.is_flag(landings, "in_time_assumed"):
        name = "assumed computation time ends before ignition"
        fractions[name] = rates.fraction_of(populations.flag_mask(landings, "in_time_assumed"), landings)
    return fractions


def _landing_model(subject: Subject) -> dict[str, str]:
    """Return the parameters of the campaign's model of the last seconds, for the note of the table of speeds."""
    model = TouchdownParameters.model_validate(subject.run.parameter("landing") or {})
    return {
        "computation": f"{model.computation_s:g}",
        "deadband": f"{model.steering_deadband_m_s:g}",
        "max_steering": f"{model.max_steering_m_s:g}",
        "steering": f"{100.0 * model.steering_error:g}",
        "burn": f"{model.burn_error_m_s:g}",
    }


_LANDING_NOTE = (
    "{missing}{bounds}Steering tilts the rocket burn against the reported velocity, which the IMU propagates to "
    "ignition. It removes at most {max_steering} m/s. {not_steered} of {landings} landings are not steered and have "
    "the same speed in both columns. Possible reasons: no velocity was reported; the computation ended after ignition "
    "(assumed duration: {computation} s); the propagated velocity was at most {deadband} m/s. The burn adds an error "
    "of {burn} m/s to each landing. Steering adds an error of {steering} % of the removed velocity. Both errors are "
    "assumed, rms per axis. The speed with steering is therefore usually larger than the velocity error at ignition. "
    "Largest decrease of the speed by steering: {gain}. Largest increase: {loss}."
)


def create_speed_block(landings: pd.DataFrame, subject: Subject) -> Block:
    """Create the table of touchdown speeds with and without steering: mean, quantiles, fractions above speeds."""
    columns = [numbers(landings, name) for name in (SPEED_CORRECTED, SPEED_UNCORRECTED)]
    groups = rates.terrain_groups(landings)
    change = columns[0] - columns[1]
    rows = [["mean (m/s)", *(number(float(values.mean())) for values in columns)]]
    for probability in (0.5, 0.95, 0.99):
        texts = []
        for values in columns:
            bound = quantile_bounds(values, probability, CONFIDENCE, groups)[1]
            bound_text = f" (≤ {number(bound)})" if np.isfinite(bound) else ""
            texts.append(f"{number(rates.quantile(values, probability))}{bound_text}")
        name = "median" if probability == 0.5 else f"{format_fraction(probability)} quantile"
        rows.append([f"{name} (m/s)", *texts])
    rows += [
        [f"faster than {speed:g} m/s", *(percent(float(np.mean(values > speed))) for values in columns)]
        for speed in SPEEDS_M_S
    ]
    improved, degraded, *_ = landing_fractions(landings).values()
    data = {
        "landings": len(landings),
        "reduced_fraction": improved.fraction,
        "increased_fraction": degraded.fraction,
        "mean_with_m_s": float(columns[0].mean()),
        "mean_without_m_s": float(columns[1].mean()),
        "largest_gain_m_s": float(-change.min()),
        "largest_loss_m_s": float(change.max()),
    }
    gain, loss = (f"{number(value)} m/s" if value > 0.0 else "none" for value in (-change.min(), change.max()))
    kept_rows, missing = omit_empty_rows(rows)
    has_bounds = any("≤" in text for row in kept_rows for text in row)
    bounds = f"The sign ≤ marks upper bounds at {format_fraction(CONFIDENCE)} confidence. " if has_bounds else ""
    note = _LANDING_NOTE.format(
        missing=missing, bounds=bounds, gain=gain, loss=loss, not_steered=int((change == 0.0).sum()),
        landings=len(landings), **_landing_model(subject),
    )  # fmt: skip
    grid = Grid(["", "With steering", "Without steering"], kept_rows)
    return Block(heading="Speeds with and without steering", grid=grid, note=note, data=data)
