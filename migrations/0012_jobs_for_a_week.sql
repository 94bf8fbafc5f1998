-- What jobs begin with, whom they tell of their end, and what they hand to their parent. Times are milliseconds.

-- Weights that jobs begin with. Jobs that begin with the same weights share a row.
CREATE TABLE initial_weights (
    sha256      TEXT PRIMARY KEY NOT NULL,
    -- A checkpoint as safetensors.
    bytes       BLOB NOT NULL
) STRICT;
-- SHA-256 of the weights that the job begins with. NULL: they are drawn.
ALTER TABLE jobs ADD COLUMN init TEXT;
CREATE INDEX jobs_init ON jobs (init) WHERE init IS NOT NULL;
CREATE TRIGGER initial_weights_unused AFTER DELETE ON jobs
WHEN old.init IS NOT NULL AND NOT EXISTS (SELECT 1 FROM jobs WHERE init = old.init)
BEGIN
    DELETE FROM initial_weights WHERE sha256 = old.init;
END;

-- Whom jobs tell of their end. Secrets are here and not in the documents, which callers see.
CREATE TABLE job_webhooks (
    job         INTEGER PRIMARY KEY NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    url         TEXT NOT NULL,
    secret      TEXT
) STRICT;

-- Messages that have not arrived yet. A job may be deleted before.
CREATE TABLE webhook_messages (
    id          TEXT PRIMARY KEY NOT NULL,
    job         TEXT NOT NULL,
    url         TEXT NOT NULL,
    secret      TEXT,
    body        TEXT NOT NULL,
    tries       INTEGER NOT NULL DEFAULT 0,
    next_at     INTEGER NOT NULL
) STRICT;
CREATE INDEX webhook_messages_next ON webhook_messages (next_at);

-- Jobs that retention deletes, in the order of their end.
CREATE INDEX jobs_ended ON jobs (ended_at, number) WHERE ended_at IS NOT NULL AND parent IS NULL;
