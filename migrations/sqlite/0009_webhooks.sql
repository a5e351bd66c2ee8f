-- Where an organisation wants to hear of the ends of its jobs, those of one plant or all. The secret signs what is sent, so
-- that it cannot be kept as a digest.
CREATE TABLE webhooks (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    organisation_id TEXT NOT NULL REFERENCES organisations (id) ON DELETE CASCADE,
    plant_id TEXT REFERENCES plants (id) ON DELETE CASCADE,
    url TEXT NOT NULL,
    secret TEXT NOT NULL,
    created_ms BIGINT NOT NULL
);

CREATE INDEX webhooks_of_organisation ON webhooks (organisation_id, seq);
CREATE INDEX webhooks_of_plant ON webhooks (plant_id);

-- A message to be sent, written together with the end of its job. `attempts` counts how often it was taken to be sent, so that
-- whoever took it before knows that it is in other hands; `attempts_left` is how often it is still tried. While one is being
-- sent, `run_after_ms` is when whoever sends it is taken for dead.
CREATE TABLE deliveries (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    webhook_id TEXT NOT NULL REFERENCES webhooks (id) ON DELETE CASCADE,
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    state TEXT NOT NULL CHECK (state IN ('waiting', 'delivered', 'dead')),
    attempts BIGINT NOT NULL DEFAULT 0,
    attempts_left BIGINT NOT NULL,
    run_after_ms BIGINT NOT NULL,
    error TEXT,
    created_ms BIGINT NOT NULL,
    finished_ms BIGINT
);

CREATE INDEX deliveries_waiting ON deliveries (run_after_ms) WHERE state = 'waiting';
CREATE INDEX deliveries_of_webhook ON deliveries (webhook_id, seq);
CREATE INDEX deliveries_of_job ON deliveries (job_id);
