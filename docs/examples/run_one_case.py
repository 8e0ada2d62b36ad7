"""Run and score one descent over a small terrain, and list its products, such as images."""

import marsyard

campaign = marsyard.load_campaign(
    "dimes-smoke",
    # a terrain of 4 km with coarse samples is built quickly; terrains of sites have finer samples
    {"terrain.samples": 512, "terrain.spacing_m": 8.0, "location.bank": 1, "location.terrain": 0},
)
case = marsyard.run_case(campaign, 3)
print(case.outcome, "answered" if case.answered else "no answer")

row = case.row
print(f"altitude {row['altitude_1_m']:.0f} m, {row['horizontal_speed_m_s']:.1f} m/s")
if case.answered:
    print(f"velocity error {row['velocity_error_m_s']:.2f} m/s")

print("products:", ", ".join(sorted(case.products)))
