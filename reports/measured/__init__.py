"""Real cases: how their pictures and measured poses agree."""
