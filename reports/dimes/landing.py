"""What an estimator's answer does to the landing: horizontal speed at touchdown with and without it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports.answers import CONFIDENCE, share_of
from marsyard.reports.columns import numbers
from marsyard.reports.plates import plate
from marsyard.reports.populations import is_flag, members, terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.samples import Groups, quantile_bounds
from marsyard.reports.svg import SERIES, in_page_style, new_axes
from marsyard.reports.wording import number, percent, stated

WITH, WITHOUT = "touchdown_speed_with_m_s", "touchdown_speed_without_m_s"
#: Column of true and false: whether the answer was there when thrusters fired.
IN_TIME = "answer_punctual"
#: A landing is helped or harmed where the speeds differ by more than this, m/s.
NOTABLE_M_S = 1.0
#: Speeds that the table tells the share above of, m/s.
SPEEDS_M_S = (5.0, 10.0, 15.0, 20.0, 25.0)


def landing_section(subject: Subject) -> Section | None:
    """Speeds at touchdown; None where the rows hold none."""
    frame = subject.frame
    speeds = {name: numbers(frame, name) for name in (WITH, WITHOUT)}
    known = np.isfinite(np.column_stack(list(speeds.values()))).all(axis=1)
    if not known.any():
        return None
    landed = frame[known]
    with_it, without = speeds[WITH][known], speeds[WITHOUT][known]
    change = with_it - without
    shares = {
        f"slower by more than {NOTABLE_M_S:g} m/s": share_of(change < -NOTABLE_M_S, landed),
        f"faster by more than {NOTABLE_M_S:g} m/s": share_of(change > NOTABLE_M_S, landed),
    }
    if is_flag(landed, IN_TIME):
        punctual = members(landed, IN_TIME)
        shares["computed before the thrusters fired, of all landings"] = share_of(punctual, landed)
    rows = [
        [
            name,
            f"{one.hits:,} of {one.n:,}",
            percent(one.share),
            f"{percent(one.sound_lower)} to {percent(one.sound_upper)}",
        ]
        for name, one in shares.items()
    ]
    caption = "Share of landings with a horizontal speed at touchdown of more than so much."
    figure = speed_figure(with_it, without)
    drawn = plate(figure, "landing", caption)
    confidence = stated(CONFIDENCE)
    gain, loss = number(float(-change.min())), number(float(change.max()))
    note = (
        f"The same descents, with the answer used and not used. Intervals: two-sided, Clopper and Pearson, at "
        f"{confidence} confidence, which allow for shared terrains. Largest gain and loss: {gain} and {loss} m/s."
    )
    blocks = [
        Block(plates=[drawn]),
        Block(heading="Good and harm", grid=Grid(["", "Landings", "Share", f"{confidence} interval"], rows), note=note),
        Block(heading="Horizontal speed at touchdown", grid=_speeds_grid(with_it, without, terrain_groups(landed))),
    ]
    data = {
        "landings": int(known.sum()),
        "helped": shares[f"slower by more than {NOTABLE_M_S:g} m/s"].share,
        "harmed": shares[f"faster by more than {NOTABLE_M_S:g} m/s"].share,
        "mean_with_m_s": float(with_it.mean()),
        "mean_without_m_s": float(without.mean()),
        "largest_gain_m_s": float(-change.min()),
        "largest_loss_m_s": float(change.max()),
    }
    return Section("landing", "Landing", "Horizontal speed at the ground", blocks, data)


@in_page_style
def speed_figure(with_it: Float[np.ndarray, " n"], without: Float[np.ndarray, " n"]) -> Figure:
    """Shares of landings faster than each speed, with and without the estimator."""
    figure, axes = new_axes(6.4, 3.4)
    for values, name, colour, line in ((without, "without", SERIES[1], "--"), (with_it, "with", SERIES[0], "-")):
        ordered = np.sort(values)
        share = 1.0 - np.arange(1, ordered.size + 1) / ordered.size
        steps = np.concatenate([[0.0], ordered])
        axes.plot(
            steps, np.concatenate([[1.0], share]), drawstyle="steps-post", color=colour, linestyle=line, label=name
        )
    axes.set(xlabel="horizontal speed at touchdown (m/s)", ylabel="share of landings faster", ylim=(0.0, 1.03))
    axes.set_xlim(left=0.0)
    axes.legend(loc="upper right")
    return figure


def _speeds_grid(with_it: Float[np.ndarray, " n"], without: Float[np.ndarray, " n"], groups: Groups) -> Grid:
    """Mean, quantiles with bounds, and shares above round speeds."""
    columns = (with_it, without)
    rows = [["mean (m/s)", *(number(float(values.mean())) for values in columns)]]
    for probability in (0.5, 0.95, 0.99):
        texts = []
        for values in columns:
            bound = quantile_bounds(values, probability, CONFIDENCE, groups)[1]
            known = f" (≤ {number(bound)})" if np.isfinite(bound) else ""
            texts.append(f"{number(float(np.quantile(values, probability)))}{known}")
        rows.append([f"{stated(probability)} quantile (its bound)", *texts])
    rows += [
        [f"faster than {speed:g} m/s", *(percent(float(np.mean(values > speed))) for values in columns)]
        for speed in SPEEDS_M_S
    ]
    return Grid(["", "With", "Without"], rows)
