"""What a campaign would fly, before anything is run: its draws as a frame."""

import marsyard

campaign = marsyard.load_campaign("dimes-smoke", cases=200)
print(campaign.configuration.description)

drawn = marsyard.draws(campaign, 200)
for path in ("descent.altitude_first_m", "descent.wind_east_m_s", "descent.cone_angle_deg"):
    column = drawn[path]
    print(f"{path}: {column.min():.1f} to {column.max():.1f}, mean {column.mean():.1f}")

# the same case of the same campaign draws the same, alone or among thousands
same = marsyard.draw(campaign, 7) == drawn.loc[7].to_dict()
print("case 7 alone draws the same:", same)
