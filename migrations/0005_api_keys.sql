-- Keys that callers show. Rows are never deleted: a server that ever had a key asks for one. Times are milliseconds since the
-- Unix epoch.
CREATE TABLE api_keys (
    id           TEXT PRIMARY KEY NOT NULL,
    name         TEXT NOT NULL,
    -- SHA-256 of the secret, which is kept nowhere.
    digest       BLOB NOT NULL CHECK (length(digest) = 32),
    -- Separated by commas.
    scopes       TEXT NOT NULL,
    -- Requests per second, and how many at once; NULL: the server's default.
    rate         REAL,
    burst        REAL,
    created_at   INTEGER NOT NULL,
    expires_at   INTEGER,
    revoked_at   INTEGER,
    last_used_at INTEGER,
    -- One more with every change that matters to a running server, which looks at the largest now and then.
    revision     INTEGER NOT NULL
) STRICT;

CREATE INDEX api_keys_revision ON api_keys (revision);
