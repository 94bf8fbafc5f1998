-- Jobs that wait for other jobs or for a time, and jobs whose result is a document. Times are milliseconds.

-- Jobs that must succeed before this one can start and have not.
ALTER TABLE jobs ADD COLUMN blocked INTEGER NOT NULL DEFAULT 0;
-- When the next attempt may begin, after one that failed. NULL: at once.
ALTER TABLE jobs ADD COLUMN not_before INTEGER;
-- Time for which the attempts that have ended ran, since the job was last retried.
ALTER TABLE jobs ADD COLUMN ran INTEGER NOT NULL DEFAULT 0;
-- What the job found out, as JSON. NULL: nothing yet, or it publishes a policy.
ALTER TABLE jobs ADD COLUMN result TEXT;

DROP INDEX jobs_queue;
CREATE INDEX jobs_queue ON jobs (state, blocked, priority DESC, number, threads, not_before);
CREATE INDEX jobs_delayed ON jobs (not_before) WHERE state = 'queued' AND not_before IS NOT NULL;

CREATE TABLE job_dependencies (
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    -- The job that must succeed first.
    needs       INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    PRIMARY KEY (job, needs)
) STRICT, WITHOUT ROWID;
CREATE INDEX job_dependencies_needs ON job_dependencies (needs);
