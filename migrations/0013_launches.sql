-- Workers that a cluster was asked to start, until they have ended: at most one per job. A job stays queued until its worker calls.
CREATE TABLE launches (
    job         INTEGER PRIMARY KEY REFERENCES jobs (number) ON DELETE CASCADE,
    -- The attempt that begins with the first call of the worker.
    attempt     INTEGER NOT NULL,
    -- SHA-256 of the token its worker shows.
    token       BLOB NOT NULL CHECK (length(token) = 32),
    -- Its name at the cluster, which is never used again.
    name        TEXT NOT NULL,
    created_at  INTEGER NOT NULL
) STRICT;
