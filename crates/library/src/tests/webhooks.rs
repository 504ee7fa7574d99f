use super::*;

on_both! {
    an_event_goes_to_its_owners_webhooks_and_those_for_all,
    a_delivery_is_retried_and_finally_fails,
    a_webhook_has_two_deliveries_under_way_in_order,
    the_attempt_of_a_dead_process_is_repeated,
    a_webhook_that_is_gone_or_fails_for_days_is_disabled,
    configured_webhooks_follow_the_configuration,
    the_log_of_deliveries_is_bounded,
    the_end_of_each_job_and_room_is_announced,
}

fn to(url: &str) -> NewWebhook {
    NewWebhook { url: url.into(), secret: "whsec_".into(), events: EventType::ALL.to_vec() }
}

fn attempt(verdict: Verdict) -> Attempt {
    Attempt { verdict, status: Some(500), error: Some("500".into()), took: Duration::from_millis(7) }
}

async fn next_due(library: &Library) -> DueDelivery {
    library.take_deliveries(1).await.unwrap().pop().unwrap()
}

/// Takes all that is due and delivers it; returns what it was, in order.
async fn told(library: &Library) -> Vec<(String, EventType, EventData)> {
    let mut all = Vec::new();
    loop {
        let due = library.take_deliveries(9).await.unwrap();
        if due.is_empty() {
            return all;
        }
        for due in due {
            library.record_attempt(&due, &attempt(Verdict::Delivered)).await.unwrap();
            all.push((due.webhook.url, due.delivery.event, due.delivery.data));
        }
    }
}

async fn an_event_goes_to_its_owners_webhooks_and_those_for_all(bed: Bed) {
    let library = bed.node().await;
    let (ann, bob) = (owner("ann").owner.unwrap(), owner("bob").owner.unwrap());
    library.add_webhook(Some(&ann), &to("ann")).await.unwrap();
    library.add_webhook(Some(&bob), &to("bob")).await.unwrap();
    let deleted = NewWebhook { events: vec![EventType::PhotoDeleted], ..to("deleted") };
    library.add_webhook(None, &deleted).await.unwrap();
    let photo = done(&library, 1, owner("ann")).await;
    let seen = told(&library).await;
    assert_eq!(seen.len(), 1, "{seen:?}");
    assert_eq!((seen[0].0.as_str(), seen[0].1, seen[0].2.photo), ("ann", EventType::PhotoDone, Some(photo.id)));
    assert_eq!(seen[0].2.title.as_deref(), Some("Photo 1"));
    assert_eq!(library.webhooks(Some(&ann)).await.unwrap().len(), 1);
    assert_eq!(library.webhooks(None).await.unwrap().len(), 3);
    library.delete(photo.id, None).await.unwrap();
    let mut seen: Vec<_> = told(&library).await.into_iter().map(|(url, event, _)| (url, event)).collect();
    seen.sort();
    assert_eq!(seen, [("ann".into(), EventType::PhotoDeleted), ("deleted".into(), EventType::PhotoDeleted)]);
    for n in 1..MAX_WEBHOOKS {
        library.add_webhook(Some(&ann), &to(&n.to_string())).await.unwrap();
    }
    assert!(matches!(library.add_webhook(Some(&ann), &to("one more")).await, Err(LibraryError::TooManyWebhooks { limit: MAX_WEBHOOKS })));
    // others have room
    library.add_webhook(Some(&bob), &to("bob")).await.unwrap();
}

async fn a_delivery_is_retried_and_finally_fails(bed: Bed) {
    let pauses = [Duration::from_secs(10), Duration::from_secs(100)];
    let library = bed.node_with(Limits { retries: pauses.to_vec(), ..Limits::default() }).await;
    let webhook = library.add_webhook(None, &to("x")).await.unwrap();
    assert_eq!(library.next_delivery_in().await.unwrap(), None);
    let id = library.ping(&webhook.id).await.unwrap();
    for (n, pause) in pauses.into_iter().enumerate() {
        assert_eq!(library.next_delivery_in().await.unwrap(), Some(Duration::ZERO));
        let due = library.take_deliveries(9).await.unwrap().pop().unwrap();
        assert_eq!((due.delivery.id.as_str(), due.delivery.attempts), (id.as_str(), n as i64 + 1));
        assert!(library.take_deliveries(9).await.unwrap().is_empty(), "it is under way");
        // the longer of the two pauses counts, within a bound
        let asked = (n == 0).then_some(Duration::from_secs(50));
        assert_eq!(library.record_attempt(&due, &attempt(Verdict::Refused(asked))).await.unwrap(), DeliveryState::Pending);
        let wait = library.next_delivery_in().await.unwrap().unwrap();
        let pause = asked.unwrap_or(pause);
        assert!(wait + Duration::from_secs(5) > pause && wait < pause * 6 / 5, "{wait:?}");
        assert!(library.take_deliveries(9).await.unwrap().is_empty(), "it waits");
        bed.jump(millis(pause) * 6 / 5);
    }
    let due = library.take_deliveries(9).await.unwrap().pop().unwrap();
    assert_eq!(library.record_attempt(&due, &attempt(Verdict::Refused(None))).await.unwrap(), DeliveryState::Failed);
    assert!(matches!(library.record_attempt(&due, &attempt(Verdict::Delivered)).await, Err(LibraryError::LeaseLost)));
    assert_eq!(library.next_delivery_in().await.unwrap(), None);
    let log = library.deliveries(&webhook.id, None, 9).await.unwrap();
    let one = &log.deliveries[0];
    assert_eq!((one.state, one.status, one.attempts, one.took_ms), (DeliveryState::Failed, Some(500), 3, Some(7)));
    assert!(one.ended_at.is_some() && one.error.as_deref() == Some("500") && log.next.is_none());
    assert!(library.webhook(&webhook.id).await.unwrap().failing_since.is_some());
}

async fn a_webhook_has_two_deliveries_under_way_in_order(bed: Bed) {
    let nodes = [bed.node().await, bed.node().await];
    let (one, other) = (nodes[0].add_webhook(None, &to("one")).await.unwrap(), nodes[0].add_webhook(None, &to("other")).await.unwrap());
    let mut pings = Vec::new();
    for _ in 0..5 {
        pings.push(nodes[0].ping(&one.id).await.unwrap());
        bed.jump(1);
    }
    nodes[0].ping(&other.id).await.unwrap();
    assert!(pings.is_sorted());
    let (first, second) = tokio::join!(nodes[0].take_deliveries(9), nodes[1].take_deliveries(9));
    let mut due = [first.unwrap(), second.unwrap()].concat();
    due.sort_by(|a, b| a.delivery.id.cmp(&b.delivery.id));
    let ids: Vec<&str> = due.iter().filter(|due| due.webhook.url == "one").map(|due| due.delivery.id.as_str()).collect();
    assert_eq!(ids, &pings[..2], "a webhook does not wait for another");
    assert_eq!(due.len(), 3);
    nodes[1].record_attempt(&due[0], &attempt(Verdict::Refused(None))).await.unwrap();
    let next = nodes[1].take_deliveries(9).await.unwrap();
    assert_eq!((next.len(), next[0].delivery.id.as_str()), (1, pings[2].as_str()), "one that fails does not hold up the next");
    // a page of two, from the newest on
    let page = nodes[0].deliveries(&one.id, None, 2).await.unwrap();
    assert_eq!(page.deliveries.iter().map(|d| d.id.as_str()).collect::<Vec<_>>(), [pings[4].as_str(), pings[3].as_str()]);
    let page = nodes[0].deliveries(&one.id, page.next.as_deref(), 9).await.unwrap();
    assert_eq!((page.deliveries.len(), page.next), (3, None));
}

async fn the_attempt_of_a_dead_process_is_repeated(bed: Bed) {
    let library = bed.node().await;
    let webhook = library.add_webhook(None, &to("x")).await.unwrap();
    library.ping(&webhook.id).await.unwrap();
    let dead = next_due(&library).await;
    bed.jump(60_001);
    let again = next_due(&library).await;
    assert_eq!(again.delivery.id, dead.delivery.id);
    assert!(matches!(library.record_attempt(&dead, &attempt(Verdict::Delivered)).await, Err(LibraryError::LeaseLost)));
    // a process that is alone need not wait
    library.reclaim().await.unwrap();
    let third = next_due(&library).await;
    library.record_attempt(&third, &attempt(Verdict::Delivered)).await.unwrap();
    assert_eq!(library.deliveries(&webhook.id, None, 9).await.unwrap().deliveries[0].state, DeliveryState::Delivered);
}

async fn a_webhook_that_is_gone_or_fails_for_days_is_disabled(bed: Bed) {
    let library = bed.node_with(Limits { retries: Vec::new(), ..Limits::default() }).await;
    let webhook = library.add_webhook(None, &to("x")).await.unwrap();
    let ping = async |verdict| {
        library.ping(&webhook.id).await.unwrap();
        let due = next_due(&library).await;
        library.record_attempt(&due, &attempt(verdict)).await.unwrap();
        library.webhook(&webhook.id).await.unwrap()
    };
    assert_eq!(ping(Verdict::Refused(None)).await.disabled, None);
    bed.jump(4 * 86_400_000);
    assert_eq!(ping(Verdict::Refused(None)).await.disabled, None);
    bed.jump(86_400_000);
    assert_eq!(ping(Verdict::Refused(None)).await.disabled.unwrap().reason, "its deliveries have failed for five days");
    assert!(matches!(library.ping(&webhook.id).await, Err(LibraryError::Invalid(_))));
    done(&library, 1, owner("ann")).await;
    assert_eq!(library.next_delivery_in().await.unwrap(), None, "it gets no events");
    let enable = WebhookChange { enabled: Some(true), ..WebhookChange::default() };
    let enabled = library.change_webhook(&webhook.id, &enable).await.unwrap();
    assert_eq!((enabled.disabled, enabled.failing_since), (None, None));
    assert_eq!(ping(Verdict::Refused(None)).await.disabled, None);
    assert_eq!(ping(Verdict::Delivered).await.failing_since, None);
    library.ping(&webhook.id).await.unwrap();
    assert_eq!(ping(Verdict::Gone).await.disabled.unwrap().reason, "it answers 410 Gone");
    assert_eq!(library.next_delivery_in().await.unwrap(), None, "what was pending has failed");
    let change = WebhookChange { url: Some("y".into()), events: Some(vec![EventType::PhotoDone]), enabled: Some(true) };
    let changed = library.change_webhook(&webhook.id, &change).await.unwrap();
    assert_eq!((changed.url.as_str(), changed.events, changed.disabled), ("y", vec![EventType::PhotoDone], None));
    assert!(library.remove_webhook(&webhook.id).await.unwrap() && !library.remove_webhook(&webhook.id).await.unwrap());
    assert!(library.deliveries(&webhook.id, None, 9).await.unwrap().deliveries.is_empty());
    assert!(matches!(library.change_webhook(&webhook.id, &change).await, Err(LibraryError::NotFound("webhook"))));
}

async fn configured_webhooks_follow_the_configuration(bed: Bed) {
    let library = bed.node().await;
    let own = library.add_webhook(None, &to("by a caller")).await.unwrap();
    library.configure_webhooks(&[to("a"), to("b")]).await.unwrap();
    let [a, b] = ["a", "b"].map(str::to_owned);
    let of_url = async |url: &str| library.webhooks(None).await.unwrap().into_iter().find(|webhook| webhook.url == url);
    let before = of_url(&a).await.unwrap();
    assert!(before.configured && of_url(&b).await.is_some());
    library.change_webhook(&before.id, &WebhookChange { enabled: Some(false), ..WebhookChange::default() }).await.unwrap();
    let other = NewWebhook { secret: "another".into(), events: vec![EventType::PhotoDone], ..to("a") };
    library.configure_webhooks(&[other]).await.unwrap();
    let after = of_url(&a).await.unwrap();
    assert_eq!((after.id, after.secret.as_str(), after.events.len()), (before.id, "another", 1));
    assert!(after.disabled.is_some() && of_url(&b).await.is_none());
    assert_eq!(library.webhook(&own.id).await.unwrap(), own);
}

async fn the_log_of_deliveries_is_bounded(bed: Bed) {
    let library = bed.node().await;
    let webhook = library.add_webhook(None, &to("x")).await.unwrap();
    for _ in 0..2 {
        library.ping(&webhook.id).await.unwrap();
    }
    let due = next_due(&library).await;
    library.record_attempt(&due, &attempt(Verdict::Delivered)).await.unwrap();
    bed.jump(7 * 86_400_000 + 1);
    library.sweep().await.unwrap();
    assert_eq!(count(&library, "deliveries").await, 1, "one that is pending stays");
    // each delivery that has ended fourfold until there are 1 024, with ids of their own
    told(&library).await;
    let mut tx = library.database().write().await.unwrap();
    for n in 0..10 {
        let double = format!(
            "INSERT INTO deliveries (id, webhook, event, data, created_at, run_after, attempts, state, ended_at)
             SELECT id || '{n}', webhook, event, data, created_at, run_after, attempts, state, ended_at FROM deliveries"
        );
        sqlx::query(sqlx::AssertSqlSafe(double)).execute(tx.connection()).await.unwrap();
    }
    tx.commit().await.unwrap();
    assert_eq!(count(&library, "deliveries").await, 1024);
    library.sweep().await.unwrap();
    assert_eq!(count(&library, "deliveries").await, 1000);
}

async fn the_end_of_each_job_and_room_is_announced(bed: Bed) {
    let library = bed.node_with(Limits { attempts: 1, exports_bytes: 100, ..Limits::default() }).await;
    library.add_webhook(None, &to("x")).await.unwrap();
    let photo = done(&library, 1, owner("ann")).await;
    library.accept(upload(2, owner("ann"))).await.unwrap();
    let lease = library.take(&[JobKind::Make], LEASE).await.unwrap().unwrap();
    library.fail(&lease, &Problem::new("broken-photo", "why")).await.unwrap();
    order(&library, &photo, JobKind::Film, "a", &owner("bob")).await.unwrap();
    write_next(&library, b"film").await;
    order(&library, &photo, JobKind::Film, "b", &owner("bob")).await.unwrap();
    let lease = library.take(&[JobKind::Film], LEASE).await.unwrap().unwrap();
    library.retry(&lease, &Retry::Died("signal 9".into())).await.unwrap();
    for _ in 0..2 {
        library.start_room("attic").await.unwrap();
    }
    for _ in 0..2 {
        library.end_room("attic").await.unwrap();
    }
    let claim = async |room: &str, node: &str| library.claim_room(room, node, Duration::from_secs(5)).await.unwrap();
    let (lost, origin) = (claim("cellar", "one").await, claim("cellar", "two").await);
    assert!(library.release_room("cellar", &lost).await.is_err());
    library.release_room("cellar", &origin).await.unwrap();
    // a node that has died
    claim("hall", "one").await;
    bed.jump(65_001);
    library.sweep().await.unwrap();
    // a process that was alone and has died
    library.start_room("roof").await.unwrap();
    library.sweep().await.unwrap();
    library.reclaim().await.unwrap();
    let seen = told(&library).await;
    let names: Vec<&str> = seen.iter().map(|(_, event, _)| event.name()).collect();
    let rooms = ["room.started", "room.ended"].repeat(4);
    assert_eq!(names, [&["photo.done", "photo.failed", "export.done", "export.failed"][..], &rooms].concat());
    assert_eq!(seen[1].2.problem.as_ref().unwrap().detail, "why");
    let export = seen[3].2.export.clone().unwrap();
    assert_eq!((export.key.as_str(), export.kind, export.payload), ("b", JobKind::Film, json!({"format": "b"})));
    assert_eq!((seen[3].2.problem.as_ref().unwrap().kind.as_str(), seen[3].2.photo), ("gave-up", Some(photo.id)));
    assert_eq!(seen[10].2.room.as_deref(), Some("roof"));
}
