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
