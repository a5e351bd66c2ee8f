-- Images of jobs that run, for any worker to search that finds what the job's own worker would find: the one with the same
-- `mapper`. A task is free once `lease_until_ms` has passed, and in the hands of whoever knows its `token` until then. One
-- that is `done` has its findings among the checkpoints, and goes once the job's own worker has heard of it. One that
-- another worker could not do is `left_to_owner`.
CREATE TABLE image_tasks (
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    image TEXT NOT NULL,
    position BIGINT NOT NULL,
    fingerprint TEXT NOT NULL,
    mapper TEXT NOT NULL,
    document TEXT NOT NULL,
    token TEXT UNIQUE,
    lease_until_ms BIGINT NOT NULL DEFAULT 0,
    done BOOLEAN NOT NULL DEFAULT FALSE,
    left_to_owner BOOLEAN NOT NULL DEFAULT FALSE,
    PRIMARY KEY (job_id, image)
);
