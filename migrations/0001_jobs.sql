-- Jobs and what they produce. Times are milliseconds since the Unix epoch, documents are JSON.

CREATE TABLE jobs (
    -- Order of arrival; also the key that other tables use, because it is short.
    number      INTEGER PRIMARY KEY AUTOINCREMENT,
    id          TEXT NOT NULL UNIQUE,
    state       TEXT NOT NULL CHECK (state IN ('queued', 'running', 'paused', 'cancelled', 'succeeded', 'failed')),
    -- What a running job was asked for and has not done yet.
    wanted      TEXT CHECK (wanted IN ('cancel', 'pause')),
    reason      TEXT,
    spec        TEXT NOT NULL,
    threads     INTEGER NOT NULL CHECK (threads > 0),
    priority    INTEGER NOT NULL,
    -- Attempts begun, and how many of them failed.
    attempts    INTEGER NOT NULL DEFAULT 0,
    failures    INTEGER NOT NULL DEFAULT 0,
    -- Environment steps done.
    step        INTEGER NOT NULL DEFAULT 0,
    policy      TEXT,
    created_at  INTEGER NOT NULL,
    started_at  INTEGER,
    ended_at    INTEGER
) STRICT;

CREATE INDEX jobs_queue ON jobs (state, priority DESC, number);

CREATE TABLE attempts (
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    number      INTEGER NOT NULL,
    -- SHA-256 of the token its worker shows.
    token       BLOB NOT NULL CHECK (length(token) = 32),
    started_at  INTEGER NOT NULL,
    ended_at    INTEGER,
    outcome     TEXT CHECK (outcome IN ('succeeded', 'failed', 'cancelled', 'paused', 'interrupted')),
    reason      TEXT,
    -- Last output of the worker.
    log         TEXT NOT NULL DEFAULT '',
    PRIMARY KEY (job, number)
) STRICT, WITHOUT ROWID;

CREATE TABLE events (
    id          INTEGER PRIMARY KEY AUTOINCREMENT,
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    at          INTEGER NOT NULL,
    state       TEXT NOT NULL,
    attempt     INTEGER NOT NULL,
    reason      TEXT
) STRICT;

CREATE INDEX events_job ON events (job, id);

CREATE TABLE metrics (
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    name        TEXT NOT NULL,
    step        INTEGER NOT NULL,
    -- NULL: the value was not a finite number.
    value       REAL,
    at          INTEGER NOT NULL,
    PRIMARY KEY (job, name, step)
) STRICT, WITHOUT ROWID;

-- The best and the last policy of each job.
CREATE TABLE checkpoints (
    id          TEXT PRIMARY KEY NOT NULL,
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    kind        TEXT NOT NULL CHECK (kind IN ('best', 'last')),
    attempt     INTEGER NOT NULL,
    step        INTEGER NOT NULL,
    sha256      TEXT NOT NULL,
    config      TEXT NOT NULL,
    metrics     TEXT NOT NULL,
    created_at  INTEGER NOT NULL,
    size        INTEGER NOT NULL,
    bytes       BLOB NOT NULL,
    UNIQUE (job, kind)
) STRICT;

-- Everything a job needs to go on exactly where it was. Only the newest complete one of a job is kept.
CREATE TABLE snapshots (
    id          INTEGER PRIMARY KEY AUTOINCREMENT,
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    attempt     INTEGER NOT NULL,
    step        INTEGER NOT NULL,
    size        INTEGER NOT NULL DEFAULT 0,
    -- NULL while it is being uploaded.
    sha256      TEXT,
    created_at  INTEGER NOT NULL
) STRICT;

CREATE INDEX snapshots_job ON snapshots (job);

CREATE TABLE snapshot_chunks (
    snapshot    INTEGER NOT NULL REFERENCES snapshots (id) ON DELETE CASCADE,
    number      INTEGER NOT NULL,
    bytes       BLOB NOT NULL,
    PRIMARY KEY (snapshot, number)
) STRICT;

CREATE TABLE idempotency_keys (
    key         TEXT PRIMARY KEY NOT NULL,
    -- SHA-256 of the canonical body it came with first.
    body        BLOB NOT NULL CHECK (length(body) = 32),
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    created_at  INTEGER NOT NULL
) STRICT;

CREATE INDEX idempotency_keys_job ON idempotency_keys (job);
