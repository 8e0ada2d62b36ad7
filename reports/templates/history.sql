-- Tables of the history of nights, see `marsyard.reports.night_history`.
CREATE TABLE nights (
    night INTEGER PRIMARY KEY, started_utc TEXT NOT NULL, finished_utc TEXT, state TEXT NOT NULL, git_commit TEXT
);
CREATE TABLE campaigns (
    night INTEGER NOT NULL REFERENCES nights, name TEXT NOT NULL, definition TEXT NOT NULL, directory TEXT NOT NULL,
    verdict TEXT NOT NULL, exit_code INTEGER NOT NULL, sentence TEXT NOT NULL, PRIMARY KEY (night, name)
);
CREATE TABLE figures (
    night INTEGER NOT NULL REFERENCES nights, campaign TEXT NOT NULL, figure TEXT NOT NULL, rate INTEGER NOT NULL,
    level REAL, amounts BLOB NOT NULL, terrains BLOB NOT NULL, PRIMARY KEY (night, campaign, figure)
);
CREATE TABLE changes (
    night INTEGER NOT NULL REFERENCES nights, campaign TEXT NOT NULL, figure TEXT NOT NULL, p_value REAL NOT NULL,
    worse INTEGER NOT NULL, PRIMARY KEY (night, campaign, figure)
);
