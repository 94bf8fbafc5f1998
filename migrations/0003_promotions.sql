-- Every move of an alias, in order. Times are milliseconds since the Unix epoch.
CREATE TABLE policy_promotions (
    id          INTEGER PRIMARY KEY AUTOINCREMENT,
    name        TEXT NOT NULL,
    alias       TEXT NOT NULL,
    -- What it means since then; NULL: nothing, it was deleted.
    version     INTEGER,
    -- What it meant before; NULL: nothing, it was new.
    previous    INTEGER,
    at          INTEGER NOT NULL,
    -- Who moved it, where that is known.
    by          TEXT,
    CHECK (version IS NOT previous),
    FOREIGN KEY (name, version) REFERENCES policy_versions (name, version),
    FOREIGN KEY (name, previous) REFERENCES policy_versions (name, version)
) STRICT;

CREATE INDEX policy_promotions_name ON policy_promotions (name, id);

-- Versions that are not to be served until they are loaded again. Baselines are in no other table.
CREATE TABLE policies_unloaded (
    name        TEXT NOT NULL,
    version     INTEGER NOT NULL,
    at          INTEGER NOT NULL,
    PRIMARY KEY (name, version)
) STRICT, WITHOUT ROWID;
