use super::*;

on_both! {
    a_room_has_one_origin_and_a_higher_epoch_each_time,
    the_last_of_several_nodes_that_claim_a_room_has_it,
}

const SECONDS: Duration = Duration::from_secs(5);

async fn a_room_has_one_origin_and_a_higher_epoch_each_time(bed: Bed) {
    let (one, two) = (bed.node().await, bed.node().await);
    assert_eq!(one.room("attic").await.unwrap(), None);
    let first = one.claim_room("attic", "one:8080", SECONDS).await.unwrap();
    assert_eq!(two.room("attic").await.unwrap(), Some(first.clone()));
    bed.jump(4_000);
    one.renew_room("attic", &first, SECONDS).await.unwrap();
    bed.jump(4_000);
    assert!(two.room("attic").await.unwrap().is_some());
    bed.jump(1_001);
    assert_eq!(two.room("attic").await.unwrap(), None, "its lease has expired");
    let second = two.claim_room("attic", "two:8080", SECONDS).await.unwrap();
    assert!(second.epoch > first.epoch);
    assert!(matches!(one.renew_room("attic", &first, SECONDS).await, Err(LibraryError::LeaseLost)));
    // the publisher reconnects elsewhere before the lease expires
    let third = one.claim_room("attic", "one:8080", SECONDS).await.unwrap();
    assert_eq!(one.room("attic").await.unwrap(), Some(third.clone()));
    assert!(third.epoch > second.epoch && matches!(two.renew_room("attic", &second, SECONDS).await, Err(LibraryError::LeaseLost)));
    one.release_room("attic", &third).await.unwrap();
    assert_eq!(two.room("attic").await.unwrap(), None);
    let fourth = two.claim_room("attic", "two:8080", SECONDS).await.unwrap();
    assert!(fourth.epoch > third.epoch);
    // long after, when the row has been removed
    bed.jump(1000 * 3600 * 24 * 31);
    one.sweep().await.unwrap();
    assert!(one.claim_room("attic", "one:8080", SECONDS).await.unwrap().epoch > fourth.epoch);
}

async fn the_last_of_several_nodes_that_claim_a_room_has_it(bed: Bed) {
    let nodes = bed.two_nodes(Limits::default()).await;
    let claim = |node: Library, n: u32| async move { node.claim_room("attic", &n.to_string(), SECONDS).await.unwrap() };
    let mut claims = at_once(&nodes, 12, claim).await;
    claims.sort_by_key(|origin| origin.epoch);
    claims.dedup_by_key(|origin| origin.epoch);
    assert_eq!((claims.len(), claims.pop()), (12, nodes[0].room("attic").await.unwrap()));
}
