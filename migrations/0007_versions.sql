-- Versions of policies can be deleted. Their numbers are never given to others: `last_version` is the largest that was given.
ALTER TABLE policies ADD COLUMN last_version INTEGER NOT NULL DEFAULT 0;
UPDATE policies SET last_version = (SELECT coalesce(max(v.version), 0) FROM policy_versions v WHERE v.name = policies.name);

-- The history of aliases keeps the numbers of deleted versions, so it refers to no other table.
CREATE TABLE alias_moves (
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
    CHECK (version IS NOT previous)
) STRICT;
INSERT INTO alias_moves (id, name, alias, version, previous, at, by)
    SELECT id, name, alias, version, previous, at, by FROM policy_promotions;
DROP TABLE policy_promotions;
CREATE INDEX alias_moves_name ON alias_moves (name, id);
CREATE INDEX alias_moves_alias ON alias_moves (name, alias, id);

-- What lists show of a version, so that they do not read its checkpoint. Without a row, it is read from the checkpoint once.
CREATE TABLE policy_infos (
    name        TEXT NOT NULL,
    version     INTEGER NOT NULL,
    info        TEXT NOT NULL,
    PRIMARY KEY (name, version),
    FOREIGN KEY (name, version) REFERENCES policy_versions (name, version) ON DELETE CASCADE
) STRICT, WITHOUT ROWID;

-- All that the start reads of each version.
CREATE INDEX policy_versions_start ON policy_versions (name, version, digest);
CREATE INDEX policy_aliases_version ON policy_aliases (name, version);

CREATE INDEX jobs_state ON jobs (state, number);
CREATE INDEX snapshots_incomplete ON snapshots (job) WHERE sha256 IS NULL;
