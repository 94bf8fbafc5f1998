-- What lists of jobs show has its own columns, so that a list reads no documents, and a document that this version cannot read
-- affects nothing but its own job. NULL: unknown, because the document was unreadable when the columns were filled.
ALTER TABLE jobs ADD COLUMN kind TEXT;
ALTER TABLE jobs ADD COLUMN name TEXT;
-- A JSON object.
ALTER TABLE jobs ADD COLUMN labels TEXT;
ALTER TABLE jobs ADD COLUMN algorithm TEXT;
ALTER TABLE jobs ADD COLUMN preset TEXT;
-- Decimal: seeds exceed the integers of SQLite.
ALTER TABLE jobs ADD COLUMN seed TEXT;
-- Environment steps of the whole job.
ALTER TABLE jobs ADD COLUMN steps INTEGER;

UPDATE jobs SET
    kind = json_extract(spec, '$.kind'),
    name = json_extract(spec, '$.name'),
    labels = spec -> '$.labels',
    algorithm = json_extract(spec, '$.config.algorithm'),
    preset = json_extract(spec, '$.config.preset'),
    seed = spec -> '$.config.seed',
    steps = CASE typeof(json_extract(spec, '$.config.training.steps'))
        WHEN 'integer' THEN json_extract(spec, '$.config.training.steps') END
WHERE json_valid(spec);

-- The version of the program that wrote the database last.
CREATE TABLE written_by (
    id          INTEGER PRIMARY KEY CHECK (id = 1),
    version     TEXT NOT NULL
) STRICT;
