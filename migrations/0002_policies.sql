-- Published policies. Versions are immutable; aliases move. Times are milliseconds since the Unix epoch.
CREATE TABLE policies (
    name        TEXT PRIMARY KEY NOT NULL,
    created_at  INTEGER NOT NULL
) STRICT;

-- The configuration and the metrics of a version are in its checkpoint's header.
CREATE TABLE policy_versions (
    name        TEXT NOT NULL REFERENCES policies (name),
    version     INTEGER NOT NULL CHECK (version > 0),
    digest      TEXT NOT NULL,
    checkpoint  BLOB NOT NULL,
    created_at  INTEGER NOT NULL,
    PRIMARY KEY (name, version),
    UNIQUE (name, digest)
) STRICT;

CREATE TABLE policy_aliases (
    name        TEXT NOT NULL,
    alias       TEXT NOT NULL,
    version     INTEGER NOT NULL,
    PRIMARY KEY (name, alias),
    FOREIGN KEY (name, version) REFERENCES policy_versions (name, version)
) STRICT;
