-- Owners of what callers make. An owner has the id of an API key; keys that replace each other have the same owner.

-- NULL: the key itself is the owner.
ALTER TABLE api_keys ADD COLUMN owner TEXT;

-- NULL: nobody, because the server had no keys, or the job is older than owners.
ALTER TABLE jobs ADD COLUMN owner TEXT;
-- Whether the job may publish under a name that another owner made.
ALTER TABLE jobs ADD COLUMN any_name INTEGER NOT NULL DEFAULT 0 CHECK (any_name IN (0, 1));
CREATE INDEX jobs_owner ON jobs (owner, number);

-- Who made the name. NULL: nobody, as above, or the policy is bundled with the program.
ALTER TABLE policies ADD COLUMN owner TEXT;

-- Each owner has idempotency keys of its own.
CREATE TABLE owned_idempotency_keys (
    -- Empty: nobody.
    owner       TEXT NOT NULL,
    key         TEXT NOT NULL,
    -- SHA-256 of the canonical body it came with first.
    body        BLOB NOT NULL CHECK (length(body) = 32),
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    created_at  INTEGER NOT NULL,
    PRIMARY KEY (owner, key)
) STRICT;
INSERT INTO owned_idempotency_keys (owner, key, body, job, created_at)
    SELECT '', key, body, job, created_at FROM idempotency_keys;
DROP TABLE idempotency_keys;
ALTER TABLE owned_idempotency_keys RENAME TO idempotency_keys;
CREATE INDEX idempotency_keys_job ON idempotency_keys (job);
