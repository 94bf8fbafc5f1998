-- Everything that happens to a job has a number: 1, 2, ... in the order in which it was committed. A change of state takes
-- one, and so do the metrics of one report together. A metric keeps the number under which its value was reported first.
ALTER TABLE jobs ADD COLUMN seq INTEGER NOT NULL DEFAULT 0;
ALTER TABLE events ADD COLUMN seq INTEGER NOT NULL DEFAULT 0;
ALTER TABLE metrics ADD COLUMN seq INTEGER NOT NULL DEFAULT 0;

-- What is there already is numbered by time. At the same millisecond a job begins before it reports and reports before it ends.
CREATE TABLE moments AS
    SELECT job, at, place, id, row_number() OVER (PARTITION BY job ORDER BY at, place, id) AS seq FROM (
        SELECT job, at, CASE WHEN state IN ('queued', 'running') THEN 0 ELSE 2 END AS place, id FROM events
        UNION ALL
        SELECT DISTINCT job, at, 1, 0 FROM metrics
    );
CREATE INDEX moments_index ON moments (job, at, place, id);
UPDATE events SET seq = (
    SELECT m.seq FROM moments m WHERE m.job = events.job AND m.at = events.at AND m.place <> 1 AND m.id = events.id
);
UPDATE metrics SET seq = (SELECT m.seq FROM moments m WHERE m.job = metrics.job AND m.at = metrics.at AND m.place = 1);
UPDATE jobs SET seq = coalesce((SELECT max(m.seq) FROM moments m WHERE m.job = jobs.number), 0);
DROP TABLE moments;

DROP INDEX events_job;
CREATE UNIQUE INDEX events_job ON events (job, seq);
CREATE INDEX metrics_job ON metrics (job, seq);
