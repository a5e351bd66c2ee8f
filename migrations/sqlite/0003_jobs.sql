-- Jobs that go on where they were. `attempts_before` counts the attempts before the last one that got somewhere: only
-- those since then count against `max_attempts`. `stage_ms` is what each stage took, JSON, for the next job's estimate.
ALTER TABLE jobs ADD COLUMN priority BIGINT NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN attempts_before BIGINT NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN remaining_ms BIGINT;
ALTER TABLE jobs ADD COLUMN stage_ms TEXT;

DROP INDEX jobs_waiting;
CREATE INDEX jobs_waiting ON jobs (state, priority, seq);

-- What a job has found so far, image by image. It holds for input, options and program with this fingerprint alone, and
-- goes when the job ends.
CREATE TABLE checkpoints (
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    fingerprint TEXT NOT NULL,
    document BLOB NOT NULL,
    PRIMARY KEY (job_id, name)
);

-- Plants that were deleted and whose blobs may still lie there.
CREATE TABLE deleted_plants (
    plant_id TEXT NOT NULL PRIMARY KEY,
    deleted_ms BIGINT NOT NULL
);
