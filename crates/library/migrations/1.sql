-- Columns are TEXT, BIGINT and DOUBLE PRECISION alone, which SQLite and PostgreSQL both have. Times are milliseconds since 1970 by the database's clock.

CREATE TABLE secrets (
    name TEXT PRIMARY KEY,
    value TEXT NOT NULL
);

-- A row to lock while an owner's quota is counted.
CREATE TABLE owners (
    owner TEXT PRIMARY KEY,
    created_at BIGINT NOT NULL
);

CREATE TABLE keys (
    hash TEXT PRIMARY KEY,
    name TEXT NOT NULL,
    owner TEXT NOT NULL REFERENCES owners (owner),
    scopes TEXT NOT NULL,
    created_at BIGINT NOT NULL,
    expires_at BIGINT
);

CREATE TABLE photos (
    id TEXT PRIMARY KEY,
    owner TEXT REFERENCES owners (owner),
    accepted_at BIGINT NOT NULL,
    -- when it was uploaded last
    listed_at BIGINT NOT NULL,
    viewed_at BIGINT NOT NULL,
    class BIGINT NOT NULL,
    options TEXT NOT NULL,
    settings TEXT NOT NULL,
    settings_version BIGINT NOT NULL,
    link_generation BIGINT NOT NULL,
    state TEXT NOT NULL,
    version BIGINT NOT NULL,
    finished_at BIGINT,
    details TEXT,
    problem TEXT,
    blobs TEXT NOT NULL,
    bytes BIGINT NOT NULL,
    -- when its contents were held against their digests last
    checked_at BIGINT NOT NULL
);
CREATE INDEX photos_by_age ON photos (accepted_at, id);
CREATE INDEX photos_listed ON photos (listed_at, id);
-- with the bytes, so that a quota is counted within the index
CREATE INDEX photos_by_owner ON photos (owner, listed_at, id, bytes);
CREATE INDEX photos_by_view ON photos (viewed_at, id);
CREATE INDEX photos_by_check ON photos (state, checked_at);
-- for metrics, which count and weigh all of them
CREATE INDEX photos_by_weight ON photos (state, bytes);

-- Everything that takes time. What is made of a photo leaves its result there; an export keeps its row and its result here.
CREATE TABLE jobs (
    id TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    photo TEXT NOT NULL REFERENCES photos (id) ON DELETE CASCADE,
    version BIGINT NOT NULL,
    class BIGINT NOT NULL,
    owner TEXT,
    address TEXT,
    payload TEXT NOT NULL,
    state TEXT NOT NULL,
    turn BIGINT NOT NULL,
    created_at BIGINT NOT NULL,
    run_after BIGINT NOT NULL,
    lease_until BIGINT,
    lease_token TEXT,
    attempts BIGINT NOT NULL,
    faults BIGINT NOT NULL,
    progress TEXT,
    problem TEXT,
    result TEXT,
    bytes BIGINT NOT NULL,
    used_at BIGINT NOT NULL
);
CREATE INDEX jobs_by_turn ON jobs (state, class, turn, created_at, id);
CREATE INDEX jobs_by_photo ON jobs (photo);

-- How long jobs take on average, most of all the recent ones, for how long a wait is likely to be.
CREATE TABLE durations (
    kind TEXT PRIMARY KEY,
    mean_ms DOUBLE PRECISION NOT NULL
);

-- When a task of all nodes ran last.
CREATE TABLE upkeep (
    task TEXT PRIMARY KEY,
    ran_at BIGINT NOT NULL
);

-- The database's clock as the last sweep saw it, and since when it has not jumped.
CREATE TABLE clock (
    id BIGINT PRIMARY KEY,
    seen_at BIGINT NOT NULL,
    steady_since BIGINT NOT NULL
);

CREATE TABLE rooms (
    name TEXT PRIMARY KEY,
    -- empty if a single node has all rooms
    origin TEXT NOT NULL,
    epoch BIGINT NOT NULL,
    lease_until BIGINT NOT NULL,
    -- 1 from `room.started` to `room.ended`
    live BIGINT NOT NULL
);

-- Addresses that are told of events: without an owner, of all photos and rooms.
CREATE TABLE webhooks (
    id TEXT PRIMARY KEY,
    owner TEXT REFERENCES owners (owner),
    -- 1 if it is from the configuration
    configured BIGINT NOT NULL,
    url TEXT NOT NULL,
    secret TEXT NOT NULL,
    events TEXT NOT NULL,
    created_at BIGINT NOT NULL,
    disabled_at BIGINT,
    reason TEXT,
    failing_since BIGINT
);
CREATE INDEX webhooks_by_owner ON webhooks (owner);

-- Events to tell. They outlive their photos and take no worker, so they are no jobs. Without a reference to webhooks, so that the removal
-- of a webhook can neither delay nor fail the transaction of an event.
CREATE TABLE deliveries (
    id TEXT PRIMARY KEY,
    webhook TEXT NOT NULL,
    event TEXT NOT NULL,
    data TEXT NOT NULL,
    created_at BIGINT NOT NULL,
    run_after BIGINT NOT NULL,
    attempts BIGINT NOT NULL,
    lease_until BIGINT,
    state TEXT NOT NULL,
    status BIGINT,
    error TEXT,
    took_ms BIGINT,
    ended_at BIGINT
);
CREATE INDEX deliveries_by_turn ON deliveries (state, run_after, id);
CREATE INDEX deliveries_by_webhook ON deliveries (webhook, id);
CREATE INDEX deliveries_in_flight ON deliveries (lease_until) WHERE lease_until IS NOT NULL;

-- What the sources of photos said of them. A digest is of the owner, the address and all that makes the photo the same.
CREATE TABLE sources (
    digest TEXT PRIMARY KEY,
    photo TEXT NOT NULL REFERENCES photos (id) ON DELETE CASCADE,
    etag TEXT,
    last_modified TEXT
);
CREATE INDEX sources_by_photo ON sources (photo);
