"""List the parameter values that a campaign draws for its cases, as a data frame, without running a case."""

import marsyard

campaign = marsyard.load_campaign("dimes-smoke", cases=200)
print(campaign.definition.description)

draws = marsyard.draws(campaign, 200)
for path in ("descent.altitude_first_m", "descent.wind_east_m_s", "descent.cone_angle_deg"):
    column = draws[path]
    print(f"{path}: {column.min():.1f} to {column.max():.1f}, mean {column.mean():.1f}")

# the draws of a case do not depend on the other cases
is_equal = marsyard.draw(campaign, 7) == draws.loc[7].to_dict()
print("draws of case 7 alone are equal:", is_equal)
