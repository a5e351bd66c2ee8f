//! Every statement that both databases understand, written once. Parameters are `$n`, times are milliseconds,
//! identifiers and documents are text.

macro_rules! plant {
    () => {
        "seq, id, organisation_id, name, created_ms"
    };
}
macro_rules! key {
    () => {
        "seq, id, organisation_id, name, prefix, scopes, plants, created_ms, expires_ms, revoked_ms, last_used_ms"
    };
}
macro_rules! survey {
    () => {
        "seq, id, plant_id, name, created_ms"
    };
}
macro_rules! file {
    () => {
        "path, size, sha256, width_px, height_px, photo, shots, stored_ms"
    };
}
macro_rules! job {
    () => {
        "seq, id, plant_id, survey_id, state, options, priority, stage, done, total, remaining_ms, warnings, error_code, \
         error_message, attempt, max_attempts, fence, cancel_requested, model_version, created_ms, started_ms, finished_ms"
    };
}
macro_rules! webhook {
    () => {
        "seq, id, organisation_id, plant_id, url, created_ms"
    };
}
macro_rules! delivery {
    () => {
        "seq, id, webhook_id, job_id, state, attempts, attempts_left, run_after_ms, error, created_ms, finished_ms"
    };
}
macro_rules! model {
    () => {
        "seq, plant_id, version, survey_id, job_id, sha256, size, warnings, created_ms"
    };
}

pub const PING: &str = "SELECT 1";
pub const MADE_CHANGES: &str = "SELECT version FROM _sqlx_migrations WHERE success ORDER BY version";
pub const ANY_KEY: &str = "SELECT 1 FROM api_keys WHERE revoked_ms IS NULL LIMIT 1";

pub const CREATE_ORGANISATION: &str = "\
    INSERT INTO organisations (id, name, created_ms) VALUES ($1, $2, $3) ON CONFLICT (name) DO NOTHING \
    RETURNING id, name, created_ms";
pub const ORGANISATION_BY_NAME: &str = "SELECT id, name, created_ms FROM organisations WHERE name = $1";

macro_rules! usage {
    () => {
        "SELECT id, name, created_ms, max_bytes, max_plants, \
         (SELECT COUNT(*) FROM plants WHERE plants.organisation_id = organisations.id) AS plants, \
         (SELECT CAST(COALESCE(SUM(plants.bytes), 0) AS BIGINT) FROM plants \
         WHERE plants.organisation_id = organisations.id) AS bytes, \
         (SELECT CAST(COALESCE(SUM(uploads.length), 0) AS BIGINT) FROM uploads \
         JOIN surveys ON surveys.id = uploads.survey_id JOIN plants ON plants.id = surveys.plant_id \
         WHERE plants.organisation_id = organisations.id AND uploads.outcome IS NULL AND uploads.expires_ms > $1) \
         AS announced_bytes FROM organisations"
    };
}
pub const ORGANISATIONS: &str = concat!(usage!(), " ORDER BY name");
pub const USAGE: &str = concat!(usage!(), " WHERE id = $2");
pub const SET_QUOTAS: &str = "UPDATE organisations SET max_bytes = $2, max_plants = $3 WHERE id = $1";
/// Changes nothing, and keeps others waiting until the transaction ends.
pub const LOCK_QUOTAS: &str = "UPDATE organisations SET name = name WHERE id = $1 RETURNING max_bytes, max_plants";
pub const OWNER: &str = "SELECT organisation_id FROM plants WHERE id = $1";
pub const BYTES_OF_ORGANISATION: &str =
    "SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM plants WHERE organisation_id = $1";
pub const PLANTS_OF_ORGANISATION: &str = "SELECT COUNT(*) FROM plants WHERE organisation_id = $1";
/// Changes nothing. Whoever changes which blobs a plant has, or what names them, has the plant's row first: until its
/// transaction ends, no other does, and two cannot wait for each other.
pub const LOCK_PLANT: &str = "UPDATE plants SET bytes = bytes WHERE id = $1 RETURNING id";
pub const LOCK_PLANT_OF_SURVEY: &str =
    "UPDATE plants SET bytes = bytes WHERE id = (SELECT plant_id FROM surveys WHERE id = $1) RETURNING id";
/// One that rows name stays named.
pub const RESERVE_BLOB: &str = "\
    UPDATE blobs SET unused_ms = CASE WHEN unused_ms IS NULL THEN NULL ELSE $3 END \
    WHERE plant_id = $1 AND sha256 = $2 AND freeing_ms IS NULL";
pub const KEEP_BLOB: &str = "\
    INSERT INTO blobs (plant_id, sha256, size, unused_ms) VALUES ($1, $2, $3, $4) \
    ON CONFLICT (plant_id, sha256) DO NOTHING";
pub const NAME_BLOB: &str =
    "UPDATE blobs SET unused_ms = NULL WHERE plant_id = $1 AND sha256 = $2 AND freeing_ms IS NULL";

macro_rules! unnamed {
    () => {
        "NOT EXISTS (SELECT 1 FROM files JOIN surveys ON surveys.id = files.survey_id \
         WHERE surveys.plant_id = blobs.plant_id AND files.sha256 = blobs.sha256) \
         AND NOT EXISTS (SELECT 1 FROM models WHERE models.plant_id = blobs.plant_id AND models.sha256 = blobs.sha256)"
    };
}
/// Once somebody has begun to delete a blob, a job that began later cannot need it.
macro_rules! needed_by_no_job {
    () => {
        "(freeing_ms IS NOT NULL \
         OR NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.plant_id = blobs.plant_id AND jobs.state = 'running'))"
    };
}
pub const UNNAME_BLOB: &str =
    concat!("UPDATE blobs SET unused_ms = $3 WHERE plant_id = $1 AND sha256 = $2 AND ", unnamed!());
pub const PLANTS_WITH_UNUSED_BLOBS: &str = concat!(
    "SELECT DISTINCT plant_id AS id FROM blobs WHERE unused_ms IS NOT NULL \
     AND ((freeing_ms IS NULL AND unused_ms < $1) OR freeing_ms < $2) AND ",
    needed_by_no_job!(),
    " ORDER BY plant_id LIMIT $3"
);
pub const TAKE_UNUSED_BLOBS: &str = concat!(
    "UPDATE blobs SET freeing_ms = $5 WHERE plant_id = $1 AND sha256 IN (SELECT blobs.sha256 FROM blobs \
     WHERE plant_id = $1 AND unused_ms IS NOT NULL \
     AND ((freeing_ms IS NULL AND unused_ms < $2) OR freeing_ms < $3) AND ",
    unnamed!(),
    " AND ",
    needed_by_no_job!(),
    " ORDER BY sha256 LIMIT $4) RETURNING plant_id, sha256, size"
);
pub const FORGET_BLOB: &str =
    "DELETE FROM blobs WHERE plant_id = $1 AND sha256 = $2 AND freeing_ms = $3 RETURNING size";
pub const COUNT_BYTES: &str = "UPDATE plants SET bytes = bytes + $2 WHERE id = $1";

pub const CREATE_KEY: &str = concat!(
    "INSERT INTO api_keys (id, organisation_id, name, prefix, sha256, scopes, plants, created_ms, expires_ms) \
     VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9) RETURNING ",
    key!()
);
pub const KEY: &str = concat!("SELECT ", key!(), " FROM api_keys WHERE organisation_id = $1 AND id = $2");
pub const KEYS: &str = concat!(
    "SELECT ",
    key!(),
    " FROM api_keys WHERE organisation_id = COALESCE($1, organisation_id) AND seq > $2 AND created_ms >= $4 \
     AND created_ms < $5 ORDER BY seq LIMIT $3"
);
pub const KEY_OF_SECRET: &str = concat!(
    "SELECT ",
    key!(),
    " FROM api_keys WHERE (sha256 = $1 OR (previous_sha256 = $1 AND previous_until_ms > $2)) \
     AND revoked_ms IS NULL AND (expires_ms IS NULL OR expires_ms > $2)"
);
pub const REVOKE_KEY: &str = concat!(
    "UPDATE api_keys SET revoked_ms = COALESCE(revoked_ms, $3) WHERE organisation_id = $1 AND id = $2 \
     AND prefix = COALESCE($4, prefix) RETURNING ",
    key!()
);
pub const ROTATE_KEY: &str = concat!(
    "UPDATE api_keys SET previous_sha256 = sha256, previous_until_ms = $5, prefix = $3, sha256 = $4 \
     WHERE organisation_id = $1 AND id = $2 AND revoked_ms IS NULL AND prefix = COALESCE($6, prefix) RETURNING ",
    key!()
);
pub const KEY_USED: &str = "UPDATE api_keys SET last_used_ms = $2 WHERE id = $1";

pub const RECORD: &str = "\
    INSERT INTO audit (organisation_id, at_ms, key_id, key_name, method, path, status, request_id, subject) \
    VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)";
pub const FORGET_AUDIT: &str = "DELETE FROM audit WHERE at_ms < $1";
pub const AUDIT: &str = "\
    SELECT seq, organisation_id, at_ms, key_id, key_name, method, path, status, request_id, subject FROM audit \
    WHERE organisation_id = $1 AND seq < $2 AND at_ms >= $4 AND at_ms < $5 ORDER BY seq DESC LIMIT $3";

pub const CREATE_PLANT: &str = concat!(
    "INSERT INTO plants (id, organisation_id, name, created_ms) VALUES ($1, $2, $3, $4) \
     ON CONFLICT (organisation_id, name) DO NOTHING RETURNING ",
    plant!()
);
pub const PLANT_BY_NAME: &str = concat!("SELECT ", plant!(), " FROM plants WHERE organisation_id = $1 AND name = $2");
pub const PLANT: &str = concat!("SELECT ", plant!(), " FROM plants WHERE id = $1");
/// `$2` is a text that holds the identifiers of the plants that may be seen, or NULL for all.
pub const PLANTS: &str = concat!(
    "SELECT ",
    plant!(),
    " FROM plants WHERE organisation_id = $1 AND COALESCE($2, id) LIKE '%' || id || '%' AND seq > $3 \
     AND SUBSTR(name, 1, LENGTH($5)) = $5 ORDER BY seq LIMIT $4"
);
pub const DELETE_PLANT: &str = "DELETE FROM plants WHERE id = $1";
pub const NOTE_DELETED_PLANT: &str =
    "INSERT INTO deleted_plants (plant_id, deleted_ms) VALUES ($1, $2) ON CONFLICT (plant_id) DO NOTHING";
pub const DELETED_PLANTS: &str = "SELECT plant_id AS id FROM deleted_plants";
pub const FORGET_DELETED_PLANTS: &str = "DELETE FROM deleted_plants WHERE deleted_ms < $1";

pub const CREATE_SURVEY: &str = concat!(
    "INSERT INTO surveys (id, plant_id, name, created_ms) VALUES ($1, $2, $3, $4) \
     ON CONFLICT (plant_id, name) DO NOTHING RETURNING ",
    survey!()
);
pub const SURVEY_BY_NAME: &str = concat!("SELECT ", survey!(), " FROM surveys WHERE plant_id = $1 AND name = $2");
pub const SURVEY: &str = concat!("SELECT ", survey!(), " FROM surveys WHERE plant_id = $1 AND id = $2");
pub const SURVEYS: &str = concat!(
    "SELECT ",
    survey!(),
    " FROM surveys WHERE plant_id = $1 AND seq > $2 AND SUBSTR(name, 1, LENGTH($4)) = $4 ORDER BY seq LIMIT $3"
);

pub const FILE_DIGEST: &str = "SELECT sha256 FROM files WHERE survey_id = $1 AND path = $2";
pub const PUT_FILE: &str = "\
    INSERT INTO files (survey_id, path, kind, size, sha256, width_px, height_px, photo, shots, stored_ms) \
    VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10) \
    ON CONFLICT (survey_id, path) DO UPDATE SET kind = excluded.kind, size = excluded.size, sha256 = excluded.sha256, \
    width_px = excluded.width_px, height_px = excluded.height_px, photo = excluded.photo, shots = excluded.shots, \
    stored_ms = excluded.stored_ms";
/// What older versions did not look for.
pub const COMPLETE_FILE: &str = "\
    UPDATE files SET photo = $3, shots = $4 WHERE survey_id = $1 AND path = $2 AND photo IS NULL AND shots IS NULL";
pub const FILES: &str = concat!("SELECT ", file!(), " FROM files WHERE survey_id = $1 ORDER BY path");
/// All blobs that rows name, by plant and digest, after `$1` and `$2`.
pub const BLOBS: &str = "\
    SELECT plant_id, sha256, size FROM (\
        SELECT surveys.plant_id, files.sha256, files.size FROM files JOIN surveys ON surveys.id = files.survey_id \
        UNION SELECT plant_id, sha256, size FROM models\
    ) AS blobs WHERE (plant_id, sha256) > ($1, $2) ORDER BY plant_id, sha256 LIMIT $3";
pub const FILE: &str = concat!("SELECT ", file!(), " FROM files WHERE survey_id = $1 AND path = $2");
pub const PHOTOS: &str = concat!(
    "SELECT ",
    file!(),
    " FROM files WHERE survey_id = $1 AND kind = 'image' AND path > $2 AND SUBSTR(path, 1, LENGTH($4)) = $4 \
     ORDER BY path LIMIT $3"
);
pub const PHOTOS_ALIKE: &str = "\
    SELECT sha256, path FROM files WHERE survey_id = $1 AND kind = 'image' AND sha256 IN (\
        SELECT sha256 FROM files WHERE survey_id = $1 AND kind = 'image' GROUP BY sha256 HAVING COUNT(*) > 1\
    ) ORDER BY path";
pub const PHOTOS_OF_DIGEST: &str = "\
    SELECT path FROM files WHERE survey_id = $1 AND sha256 = $2 AND kind = 'image' ORDER BY path LIMIT $3";

pub const CREATE_UPLOAD: &str = "\
    INSERT INTO uploads (id, survey_id, length, received, partial, metadata, expires_ms, parts, home) \
    VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)";
macro_rules! upload {
    ($parts:literal) => {
        concat!(
            "SELECT id, survey_id, length, received, partial, metadata, expires_ms, outcome, home, ",
            $parts,
            " AS parts FROM uploads WHERE survey_id = $1 AND "
        )
    };
}
pub const UPLOAD: &str = concat!(upload!("parts"), "id = $2");
pub const UPLOADS_OF_SURVEY: &str =
    concat!(upload!("CAST(NULL AS TEXT)"), "id > $2 AND expires_ms > $4 ORDER BY id LIMIT $3");
pub const UPLOAD_RECEIVED: &str =
    "UPDATE uploads SET received = $2, expires_ms = $3, home = $4 WHERE id = $1 AND received = $5";
pub const ADD_PIECES: &str = "INSERT INTO upload_pieces (upload_id, begins, ends, name, home) ";
pub const UPLOAD_PIECES: &str =
    "SELECT begins, ends, name, home FROM upload_pieces WHERE upload_id = $1 ORDER BY begins";
pub const TAKE_UPLOAD_END: &str = "\
    UPDATE uploads SET ender = $2, ending_until_ms = $3 \
    WHERE id = $1 AND outcome IS NULL AND (ending_until_ms < $4 OR ender = $2)";
pub const END_UPLOAD: &str = "\
    UPDATE uploads SET outcome = $3, ender = NULL, ending_until_ms = 0 \
    WHERE id = $1 AND outcome IS NULL AND ender = $2";
pub const UPLOADS_OF_PLANT: &str = "\
    SELECT uploads.id FROM uploads JOIN surveys ON surveys.id = uploads.survey_id WHERE surveys.plant_id = $1";
pub const DELETE_UPLOAD: &str = "DELETE FROM uploads WHERE survey_id = $1 AND id = $2";
pub const DELETE_EXPIRED_UPLOADS: &str = "DELETE FROM uploads WHERE expires_ms <= $1";
pub const OWNER_OF_SURVEY: &str =
    "SELECT plants.organisation_id FROM surveys JOIN plants ON plants.id = surveys.plant_id WHERE surveys.id = $1";
pub const ANNOUNCED_BY_ORGANISATION: &str = "\
    SELECT COUNT(*) AS uploads, CAST(COALESCE(SUM(uploads.length), 0) AS BIGINT) AS bytes FROM uploads \
    JOIN surveys ON surveys.id = uploads.survey_id JOIN plants ON plants.id = surveys.plant_id \
    WHERE plants.organisation_id = $1 AND uploads.outcome IS NULL AND uploads.expires_ms > $2";
pub const UPLOADS: &str = "SELECT id FROM uploads";

/// Takes a name that nobody has, or whose time is over.
pub const BEGIN_REQUEST: &str = "\
    INSERT INTO requests (organisation_id, name, expires_ms, token) VALUES ($1, $2, $4, $5) \
    ON CONFLICT (organisation_id, name) DO UPDATE SET fingerprint = NULL, status = NULL, headers = NULL, body = NULL, \
    expires_ms = excluded.expires_ms, token = excluded.token WHERE requests.expires_ms <= $3";
pub const RENEW_REQUEST: &str =
    "UPDATE requests SET expires_ms = $4 WHERE organisation_id = $1 AND name = $2 AND token = $3 AND status IS NULL";
pub const REQUEST: &str =
    "SELECT fingerprint, status, headers, body FROM requests WHERE organisation_id = $1 AND name = $2";
pub const KEEP_ANSWER: &str = "\
    UPDATE requests SET fingerprint = $3, status = $4, headers = $5, body = $6, expires_ms = $7 \
    WHERE organisation_id = $1 AND name = $2 AND token = $8";
pub const FORGET_REQUEST: &str =
    "DELETE FROM requests WHERE organisation_id = $1 AND name = $2 AND token = $3 AND status IS NULL";
pub const FORGET_OLD_REQUESTS: &str = "DELETE FROM requests WHERE expires_ms <= $1";

pub const COUNT_WEBHOOKS: &str = "SELECT COUNT(*) FROM webhooks WHERE organisation_id = $1";
pub const CREATE_WEBHOOK: &str = concat!(
    "INSERT INTO webhooks (id, organisation_id, plant_id, url, secret, created_ms) VALUES ($1, $2, $3, $4, $5, $6) \
     RETURNING ",
    webhook!()
);
pub const WEBHOOK: &str = concat!("SELECT ", webhook!(), " FROM webhooks WHERE organisation_id = $1 AND id = $2");
pub const WEBHOOKS: &str =
    concat!("SELECT ", webhook!(), " FROM webhooks WHERE organisation_id = $1 AND seq > $2 ORDER BY seq LIMIT $3");
pub const DELETE_WEBHOOK: &str = "DELETE FROM webhooks WHERE organisation_id = $1 AND id = $2";
pub const WEBHOOKS_OF_JOB: &str = "\
    SELECT webhooks.id FROM jobs JOIN plants ON plants.id = jobs.plant_id \
    JOIN webhooks ON webhooks.organisation_id = plants.organisation_id \
    WHERE jobs.id = $1 AND COALESCE(webhooks.plant_id, plants.id) = plants.id ORDER BY webhooks.seq";
pub const CREATE_DELIVERY: &str = "\
    INSERT INTO deliveries (id, webhook_id, job_id, state, attempts_left, run_after_ms, created_ms) \
    VALUES ($1, $2, $3, 'waiting', $4, $5, $5)";
pub const DELIVERIES: &str = concat!(
    "SELECT ",
    delivery!(),
    " FROM deliveries WHERE webhook_id = $1 AND state = COALESCE($2, state) AND seq < $3 ORDER BY seq DESC LIMIT $4"
);
pub const RESEND_DELIVERY: &str = concat!(
    "UPDATE deliveries SET state = 'waiting', attempts_left = $4, run_after_ms = $3, finished_ms = NULL \
     WHERE webhook_id = $1 AND id = $2 RETURNING ",
    delivery!()
);
pub const DELIVERY_DUE: &str = "SELECT 1 FROM deliveries WHERE state = 'waiting' AND run_after_ms <= $1 LIMIT 1";
pub const WEBHOOK_OF_DELIVERY: &str = "SELECT organisation_id, url, secret FROM webhooks WHERE id = $1";
pub const JOB_OF_DELIVERY: &str = concat!("SELECT ", job!(), " FROM jobs WHERE id = $1");
/// `$2` the attempt, `$3` the state, `$4` what failed, `$5` the time from which to try again, `$6` the time of the end.
pub const END_DELIVERY: &str = "\
    UPDATE deliveries SET state = $3, error = $4, run_after_ms = COALESCE($5, run_after_ms), finished_ms = $6 \
    WHERE id = $1 AND attempts = $2 AND state = 'waiting'";
pub const FORGET_OLD_DELIVERIES: &str = "DELETE FROM deliveries WHERE finished_ms < $1";

pub const ENQUEUE_JOB: &str = concat!(
    "INSERT INTO jobs (id, plant_id, survey_id, state, options, max_attempts, run_after_ms, created_ms, priority) \
     VALUES ($1, $2, $3, 'queued', $4, $5, $6, $6, $7) \
     ON CONFLICT (survey_id) WHERE state IN ('queued', 'running') DO NOTHING RETURNING ",
    job!()
);
pub const UNFINISHED_JOB: &str =
    concat!("SELECT ", job!(), " FROM jobs WHERE survey_id = $1 AND state IN ('queued', 'running')");
pub const JOB: &str = concat!("SELECT ", job!(), " FROM jobs WHERE plant_id = $1 AND id = $2");
pub const JOBS_OF_PLANT: &str = concat!(
    "SELECT ",
    job!(),
    " FROM jobs WHERE plant_id = $1 AND seq < $2 AND state = COALESCE($4, state) ORDER BY seq DESC LIMIT $3"
);
pub const JOBS_OF_SURVEY: &str = concat!(
    "SELECT ",
    job!(),
    " FROM jobs WHERE plant_id = $1 AND survey_id = $5 AND seq < $2 AND state = COALESCE($4, state) \
     ORDER BY seq DESC LIMIT $3"
);
pub const CANCEL_JOB: &str = concat!(
    "UPDATE jobs SET cancel_requested = TRUE, \
     finished_ms = CASE WHEN state = 'queued' THEN $3 ELSE finished_ms END, \
     state = CASE WHEN state = 'queued' THEN 'cancelled' ELSE state END \
     WHERE plant_id = $1 AND id = $2 AND state IN ('queued', 'running') RETURNING ",
    job!()
);

pub const JOBS_BY_STATE: &str = "SELECT state, COUNT(*) AS jobs FROM jobs GROUP BY state";

/// How many plants have a job that a worker may claim, as [`postgres::CLAIM_JOB`] does, and since when the oldest may be.
pub const QUEUE: &str = "\
    SELECT COUNT(DISTINCT plant_id) AS waiting, MIN(run_after_ms) AS since_ms FROM jobs AS candidate \
    WHERE ((state = 'queued' AND run_after_ms <= $1) OR (state = 'running' AND lease_until_ms < $1)) \
    AND NOT EXISTS (SELECT 1 FROM jobs AS other WHERE other.plant_id = candidate.plant_id \
    AND other.seq <> candidate.seq AND other.state = 'running' AND other.lease_until_ms >= $1)";

/// Statements that take a row of a queue. What they ask of the row stands twice: where another transaction had the row
/// when it was chosen, it may be another's since. Where there may be such transactions, `$skip` passes over their rows
/// instead of waiting for them.
macro_rules! queues {
    ($database:ident, $skip:literal) => {
        pub mod $database {
            /// Ends jobs whose worker fell silent and that were cancelled or had their last attempt.
            pub const BURY_ABANDONED_JOBS: &str = concat!(
                "UPDATE jobs SET finished_ms = $1, lease_until_ms = NULL, \
                 error_code = CASE WHEN cancel_requested THEN error_code ELSE 'worker_lost' END, \
                 error_message = CASE WHEN cancel_requested THEN error_message ELSE $2 END, \
                 state = CASE WHEN cancel_requested THEN 'cancelled' ELSE 'failed' END \
                 WHERE state = 'running' AND lease_until_ms < $1 \
                 AND (cancel_requested OR attempt - attempts_before >= max_attempts) \
                 AND seq IN (SELECT candidate.seq FROM jobs AS candidate \
                 WHERE candidate.state = 'running' AND candidate.lease_until_ms < $1",
                $skip,
                ") RETURNING id"
            );
            pub const CLAIM_JOB: &str = concat!(
                "UPDATE jobs SET state = 'running', worker = $1, attempt = attempt + 1, fence = fence + 1, \
                 lease_until_ms = $3, started_ms = COALESCE(started_ms, $2), stage = NULL, done = 0, total = 0, \
                 remaining_ms = NULL \
                 WHERE ((state = 'queued' AND run_after_ms <= $2) OR (state = 'running' AND lease_until_ms < $2)) \
                 AND seq = (SELECT candidate.seq FROM jobs AS candidate \
                 WHERE ((candidate.state = 'queued' AND candidate.run_after_ms <= $2) \
                 OR (candidate.state = 'running' AND candidate.lease_until_ms < $2)) \
                 AND NOT EXISTS (SELECT 1 FROM jobs AS other WHERE other.plant_id = candidate.plant_id \
                 AND other.seq <> candidate.seq AND other.state = 'running' AND other.lease_until_ms >= $2) \
                 ORDER BY candidate.priority DESC, candidate.seq LIMIT 1",
                $skip,
                ") RETURNING ",
                job!()
            );
            /// The job's own worker has it for as long as it has the job: `$4` is the end of time.
            pub const TAKE_OWN_TASK: &str = concat!(
                "UPDATE image_tasks SET token = NULL, lease_until_ms = $4 \
                 WHERE job_id = $1 AND NOT done AND lease_until_ms < $3 AND image = (\
                 SELECT candidate.image FROM image_tasks AS candidate \
                 WHERE candidate.job_id = $1 AND NOT candidate.done AND candidate.lease_until_ms < $3 \
                 ORDER BY candidate.position LIMIT 1",
                $skip,
                ") AND EXISTS (SELECT 1 FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running') RETURNING image"
            );
            pub const TAKE_TASK: &str = concat!(
                "UPDATE image_tasks SET token = $3, lease_until_ms = $4 \
                 WHERE NOT done AND NOT left_to_owner AND lease_until_ms < $2 AND (job_id, image) = (\
                 SELECT candidate.job_id, candidate.image \
                 FROM image_tasks AS candidate JOIN jobs ON jobs.id = candidate.job_id \
                 WHERE candidate.mapper = $1 AND NOT candidate.done AND NOT candidate.left_to_owner \
                 AND candidate.lease_until_ms < $2 AND jobs.state = 'running' AND NOT jobs.cancel_requested \
                 ORDER BY jobs.priority DESC, jobs.seq, candidate.position LIMIT 1",
                $skip,
                ") RETURNING job_id, image, document, \
                 (SELECT plant_id FROM jobs WHERE jobs.id = image_tasks.job_id) AS plant_id"
            );
            /// Of the webhooks of organisations that are not in the text `$3`.
            pub const CLAIM_DELIVERY: &str = concat!(
                "UPDATE deliveries SET attempts = attempts + 1, run_after_ms = $2, \
                 attempts_left = CASE WHEN attempts_left > 0 THEN attempts_left - 1 ELSE 0 END \
                 WHERE state = 'waiting' AND run_after_ms <= $1 AND seq = (SELECT candidate.seq \
                 FROM deliveries AS candidate JOIN webhooks ON webhooks.id = candidate.webhook_id \
                 WHERE candidate.state = 'waiting' AND candidate.run_after_ms <= $1 \
                 AND $3 NOT LIKE '%' || webhooks.organisation_id || '%' \
                 ORDER BY candidate.run_after_ms, candidate.seq LIMIT 1",
                $skip,
                ") RETURNING ",
                delivery!()
            );
        }
    };
}
queues!(sqlite, "");
queues!(postgres, " FOR NO KEY UPDATE OF candidate SKIP LOCKED");

pub const HEARTBEAT: &str = "\
    UPDATE jobs SET lease_until_ms = $3, stage = COALESCE($4, stage), done = COALESCE($5, done), \
    total = COALESCE($6, total), remaining_ms = CASE WHEN $4 IS NULL THEN remaining_ms ELSE $7 END \
    WHERE id = $1 AND fence = $2 AND state = 'running' RETURNING cancel_requested";
pub const MADE_PROGRESS: &str =
    "UPDATE jobs SET attempts_before = attempt - 1 WHERE id = $1 AND fence = $2 AND state = 'running'";
pub const CHECKPOINT: &str = "\
    INSERT INTO checkpoints (job_id, name, fingerprint, document) VALUES ($1, $2, $3, $4) \
    ON CONFLICT (job_id, name) DO UPDATE SET fingerprint = excluded.fingerprint, document = excluded.document";
pub const CHECKPOINTS: &str =
    "SELECT name, document FROM checkpoints WHERE job_id = $1 AND fingerprint = $2 ORDER BY name";
pub const SWEEP_CHECKPOINTS: &str = "\
    DELETE FROM checkpoints WHERE job_id = $1 \
    AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.id = $1 AND jobs.state IN ('queued', 'running'))";

pub const IS_CLAIMED: &str = "SELECT 1 FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running'";
pub const WITHDRAW_TASKS: &str = "DELETE FROM image_tasks WHERE job_id = $1";
/// Rows follow, as many as one statement may have.
pub const OFFER_TASKS: &str = "INSERT INTO image_tasks (job_id, image, position, fingerprint, mapper, document) ";
pub const TASK_IN_OTHER_HANDS: &str =
    "SELECT 1 FROM image_tasks WHERE job_id = $1 AND (done OR lease_until_ms < $2) LIMIT 1";
pub const DONE_TASK: &str = "SELECT 1 FROM image_tasks WHERE job_id = $1 AND done LIMIT 1";
pub const GATHER_TASKS: &str = "\
    DELETE FROM image_tasks WHERE job_id = $1 AND done \
    AND EXISTS (SELECT 1 FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running') RETURNING image";
pub const ONE_CHECKPOINT: &str = "SELECT document FROM checkpoints WHERE job_id = $1 AND name = $2";
pub const WAITING_TASKS: &str = "\
    SELECT COUNT(*) FROM image_tasks WHERE NOT done AND NOT left_to_owner AND lease_until_ms < $1 \
    AND EXISTS (SELECT 1 FROM jobs WHERE jobs.id = image_tasks.job_id AND jobs.state = 'running' \
    AND NOT jobs.cancel_requested)";
pub const EXTEND_TASK: &str = "\
    UPDATE image_tasks SET lease_until_ms = $2 WHERE token = $1 AND EXISTS (SELECT 1 FROM jobs \
    WHERE jobs.id = image_tasks.job_id AND jobs.state = 'running' AND NOT jobs.cancel_requested)";
/// `$2` the token of one of the job's tasks.
pub const OTHERS_MADE_PROGRESS: &str = "\
    UPDATE jobs SET attempts_before = attempt - 1 WHERE id = $1 AND state = 'running' \
    AND EXISTS (SELECT 1 FROM image_tasks WHERE token = $2)";
pub const FINISH_TASK: &str = "\
    UPDATE image_tasks SET done = TRUE, token = NULL, lease_until_ms = $2 WHERE token = $1 RETURNING fingerprint";
pub const GIVE_BACK_TASK: &str = "\
    UPDATE image_tasks SET token = NULL, lease_until_ms = 0, left_to_owner = (left_to_owner OR $2) WHERE token = $1";
pub const FORGET_TASK: &str = "DELETE FROM image_tasks WHERE job_id = $1 AND image = $2";
pub const SWEEP_TASKS: &str = "\
    DELETE FROM image_tasks WHERE job_id = $1 \
    AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.id = $1 AND jobs.state IN ('queued', 'running'))";

pub const ATTEMPTS_USED: &str =
    "SELECT attempt - attempts_before FROM jobs WHERE id = $1 AND fence = $2 AND state = 'running'";
pub const LAST_STAGE_MS: &str = "SELECT stage_ms FROM jobs WHERE stage_ms IS NOT NULL ORDER BY seq DESC LIMIT 1";
pub const COMPLETE_JOB: &str = "\
    UPDATE jobs SET state = 'succeeded', finished_ms = $3, lease_until_ms = NULL, warnings = $4, model_version = $5, \
    error_code = NULL, error_message = NULL, remaining_ms = NULL, stage_ms = $6 \
    WHERE id = $1 AND fence = $2 AND state = 'running'";
/// `$3` the state, `$4` code, `$5` message, `$6` the time from which to try again, `$7` the time of the end, `$8` how many
/// attempts are given back, `$9` the time now. What was cancelled meanwhile does not go back to the queue.
pub const END_JOB: &str = "\
    UPDATE jobs SET state = CASE WHEN cancel_requested AND $3 = 'queued' THEN 'cancelled' ELSE $3 END, \
    error_code = COALESCE($4, error_code), error_message = COALESCE($5, error_message), \
    run_after_ms = COALESCE($6, run_after_ms), lease_until_ms = NULL, remaining_ms = NULL, attempt = attempt - $8, \
    finished_ms = CASE WHEN cancel_requested AND $3 = 'queued' THEN $9 ELSE $7 END \
    WHERE id = $1 AND fence = $2 AND state = 'running' RETURNING finished_ms";

pub const INSERT_MODEL: &str = concat!(
    "INSERT INTO models (plant_id, version, survey_id, job_id, sha256, size, warnings, created_ms) \
     VALUES ($1, $2, $3, $4, $5, $6, $7, $8) ON CONFLICT (plant_id, version) DO NOTHING RETURNING ",
    model!()
);
pub const INSERT_LAYER: &str = "\
    INSERT INTO layers (model_seq, layer, features, properties, min_lon, min_lat, max_lon, max_lat, tallest_deg, \
    widest_deg) VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)";
/// Rows follow, as many as one statement may have.
pub const INSERT_FEATURES: &str =
    "INSERT INTO features (model_seq, layer, seq, id, label, feature, min_lon, min_lat, max_lon, max_lat, strip) ";

pub const MODELS: &str =
    concat!("SELECT ", model!(), " FROM models WHERE plant_id = $1 AND seq < $2 ORDER BY seq DESC LIMIT $3");
pub const MODEL: &str = concat!("SELECT ", model!(), " FROM models WHERE plant_id = $1 AND version = $2");
pub const NEWEST_MODEL: &str =
    concat!("SELECT ", model!(), " FROM models WHERE plant_id = $1 ORDER BY version DESC LIMIT 1");
pub const LAYER: &str = "\
    SELECT features, properties, min_lon, min_lat, max_lon, max_lat, tallest_deg, widest_deg FROM layers \
    WHERE model_seq = $1 AND layer = $2";

pub const FEATURES: &str = "\
    SELECT seq, feature FROM features WHERE model_seq = $1 AND layer = $2 AND seq > $3 ORDER BY seq LIMIT $4";
/// A box that covers much of the layer: walk the layer in order and leave out what lies elsewhere. The unary plus
/// keeps the planner from the index by place.
pub const FEATURES_IN_LARGE_BOX: &str = "\
    SELECT seq, feature FROM features WHERE model_seq = $1 AND layer = $2 AND seq > $3 \
    AND +min_lon <= $7 AND +max_lon >= $5 AND +min_lat <= $8 AND +max_lat >= $6 ORDER BY seq LIMIT $4";
/// A box that covers little of the layer: in each strip from `$10` to `$11` take the latitudes from the index by place (which
/// holds all that the condition asks for), and put what is in the box in order. `$9` is the southernmost latitude at which
/// a feature that reaches into the box may begin. Cross joins and unary pluses hold the planner to that way.
pub const FEATURES_IN_SMALL_BOX: &str = "\
    WITH RECURSIVE strips (strip) AS (SELECT CAST($10 AS BIGINT) UNION ALL SELECT strip + 1 FROM strips WHERE strip < $11), \
    near AS MATERIALIZED (SELECT place.seq AS seq FROM strips CROSS JOIN features AS place \
    WHERE place.model_seq = $1 AND place.layer = $2 AND place.strip = strips.strip AND place.min_lat BETWEEN $9 AND $8 \
    AND place.max_lat >= $6 AND place.min_lon <= $7 AND place.max_lon >= $5 AND +place.seq > $3 \
    ORDER BY +place.seq LIMIT $4) \
    SELECT features.seq, features.feature FROM near CROSS JOIN features \
    WHERE features.model_seq = $1 AND features.layer = $2 AND features.seq = near.seq ORDER BY near.seq";
pub const MODULE: &str = "SELECT feature FROM features WHERE id = $1 AND model_seq = $2 AND layer = 'modules'";
pub const MODULE_LAST_SEEN: &str = "\
    SELECT models.version FROM features JOIN models ON models.seq = features.model_seq \
    WHERE features.id = $1 AND features.layer = 'modules' AND models.plant_id = $2 ORDER BY models.version DESC LIMIT 1";
