"""Report of localisation on a map: sections, and views of cases."""
