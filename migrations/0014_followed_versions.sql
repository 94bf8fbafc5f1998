-- Of a replica: the versions of policies that its primary has, too. It deletes them when the primary does, and no others.
CREATE TABLE followed_versions (
    name        TEXT NOT NULL,
    version     INTEGER NOT NULL,
    PRIMARY KEY (name, version)
) STRICT, WITHOUT ROWID;

-- When the policies of a replica were last known to be those of its primary, in milliseconds since the Unix epoch. No row: never.
CREATE TABLE followed_until (
    id          INTEGER PRIMARY KEY CHECK (id = 1),
    at          INTEGER NOT NULL
) STRICT;
