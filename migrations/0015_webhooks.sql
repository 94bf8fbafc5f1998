-- Addresses that are told when a job ends. Times are milliseconds.
CREATE TABLE webhooks (
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    place       INTEGER NOT NULL,
    url         TEXT NOT NULL,
    -- The states that are told, as a JSON array.
    events      TEXT NOT NULL,
    -- Key of the signatures. NULL: messages are not signed.
    secret      TEXT,
    PRIMARY KEY (job, place)
) STRICT, WITHOUT ROWID;

-- Messages that their receivers have not accepted yet. They outlive their job.
CREATE TABLE webhook_messages (
    number      INTEGER PRIMARY KEY AUTOINCREMENT,
    -- Id of the message, by which the receiver recognises repetitions.
    id          TEXT NOT NULL,
    -- Id of the job.
    job         TEXT NOT NULL,
    url         TEXT NOT NULL,
    secret      TEXT,
    -- JSON, the same in every repetition.
    body        TEXT NOT NULL,
    created_at  INTEGER NOT NULL,
    -- Failed tries so far, and when the next one is due.
    tries       INTEGER NOT NULL DEFAULT 0,
    next_at     INTEGER NOT NULL
) STRICT;
CREATE INDEX webhook_messages_next ON webhook_messages (next_at);
