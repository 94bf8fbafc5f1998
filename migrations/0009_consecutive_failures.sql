-- Attempts that failed since the job last made progress: only these count towards the limit. `failures` counts all that failed.
ALTER TABLE jobs ADD COLUMN consecutive_failures INTEGER NOT NULL DEFAULT 0;
UPDATE jobs SET consecutive_failures = failures WHERE state IN ('queued', 'running', 'paused');
