-- Jobs and what they produce. Times are milliseconds since the Unix epoch.
CREATE TABLE jobs (
    id          TEXT PRIMARY KEY NOT NULL
) STRICT;
