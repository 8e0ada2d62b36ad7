"""Reports of recorded images: agreement of the images with the measured poses."""
