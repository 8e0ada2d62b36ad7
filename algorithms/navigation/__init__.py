"""Flight software around the tracker: visual odometry, terrain map and path planner, from stereo images.

These parts drive the simulated rover while a target tracker is tested. They are not under test. As flight software they
receive measurements only: images, calibrated cameras and estimated poses.
"""
