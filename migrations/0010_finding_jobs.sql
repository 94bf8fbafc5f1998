-- Jobs are found by what they are and by what they reached.

-- What people write about the job.
ALTER TABLE jobs ADD COLUMN notes TEXT NOT NULL DEFAULT '';
-- Id of the job that made this one. NULL: a caller made it.
ALTER TABLE jobs ADD COLUMN parent TEXT;

-- Lists read these indexes only, in the order of the list, however large the documents of the jobs are.
DROP INDEX jobs_state;
CREATE INDEX jobs_by_number ON jobs (number, state, owner, kind, algorithm, parent, name, created_at);
CREATE INDEX jobs_by_state ON jobs (state, number, owner, kind, algorithm, parent, name, created_at);
CREATE INDEX jobs_by_name ON jobs (name, number, state, owner, kind, algorithm, parent, created_at);
CREATE INDEX jobs_by_parent ON jobs (parent, number, state, owner, kind, algorithm, name, created_at) WHERE parent IS NOT NULL;

-- The labels of `jobs.labels`, to find jobs by them.
CREATE TABLE job_labels (
    key         TEXT NOT NULL,
    value       TEXT NOT NULL,
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    PRIMARY KEY (key, value, job)
) STRICT, WITHOUT ROWID;
CREATE INDEX job_labels_job ON job_labels (job);
INSERT OR IGNORE INTO job_labels (key, value, job)
    SELECT l.key, l.value, j.number FROM jobs j, json_each(CASE WHEN json_valid(j.labels) THEN j.labels ELSE '{}' END) l
    WHERE l.type = 'text' AND l.key IS NOT NULL;

-- The best and the last value of each metric of a job. NULL: no value was finite.
CREATE TABLE metric_summaries (
    job         INTEGER NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    name        TEXT NOT NULL,
    best        REAL,
    best_step   INTEGER,
    last        REAL,
    last_step   INTEGER NOT NULL,
    PRIMARY KEY (job, name)
) STRICT, WITHOUT ROWID;
-- A bare column beside max() or min() comes from the row that has the maximum or the minimum.
INSERT INTO metric_summaries (job, name, last, last_step) SELECT job, name, value, max(step) FROM metrics GROUP BY job, name;
UPDATE metric_summaries SET (best, best_step) = (
    SELECT m.value, m.step FROM metrics m WHERE m.job = metric_summaries.job AND m.name = metric_summaries.name AND m.value IS NOT NULL
    ORDER BY CASE WHEN m.name IN ('env_steps_per_s', 'eval/coverage', 'eval/fairness', 'q_tot') THEN -m.value ELSE m.value END, m.step
    LIMIT 1
);
CREATE INDEX metric_summaries_best ON metric_summaries (name, best, job);
CREATE INDEX metric_summaries_last ON metric_summaries (name, last, job);
