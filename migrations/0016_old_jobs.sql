-- Jobs that have ended, by the time of their end: the rules of retention delete the oldest.
CREATE INDEX jobs_by_end ON jobs (ended_at, number, parent, id) WHERE ended_at IS NOT NULL;
