use super::*;

on_both! {
    keys_can_be_added_expire_and_be_removed,
}

fn later(bed: &Bed, library: &Library, by: Duration) {
    bed.jump(by.as_millis() as i64);
    library.0.clock.lock().unwrap().take();
}

async fn keys_can_be_added_expire_and_be_removed(bed: Bed) {
    let (library, other) = (bed.node().await, bed.node().await);
    let day = Duration::from_hours(24);
    let one = library.add_key("site", &[Scope::Upload, Scope::Read, Scope::Read], None).await.unwrap();
    let two = library.add_key("site", &[Scope::Metrics], Some(day)).await.unwrap();
    let found = other.find_key(&one.secret).await.unwrap().unwrap();
    assert_eq!(found, one.key);
    assert_eq!((found.owner, found.scopes), (two.key.owner.clone(), vec![Scope::Upload, Scope::Read]));
    assert!(two.key.may(Scope::Metrics) && !two.key.may(Scope::Read));
    assert!(two.key.link_secret().is_none(), "without the scope it signs nothing");
    assert_eq!(other.keys_of_id(&two.key.id).await.unwrap(), std::slice::from_ref(&two.key));
    assert!(library.find_key(&one.secret[..one.secret.len() - 1]).await.unwrap().is_none());
    assert_eq!(library.keys().await.unwrap().len(), 2);
    later(&bed, &library, day);
    assert!(!library.is_valid(&two.key).await.unwrap() && library.is_valid(&one.key).await.unwrap());
    assert!(library.keys_of_id(&two.key.id).await.unwrap().is_empty());
    let mut events = library.subscribe();
    assert_eq!(library.remove_keys("site", Some(&one.key.id)).await.unwrap(), 1);
    assert_eq!(events.next().await, Some(Event::Revoked));
    assert!(other.find_key(&one.secret).await.unwrap().is_none());
    assert!(matches!(library.remove_keys("sites", None).await, Err(LibraryError::NotFound("key"))));
    assert_eq!(library.remove_keys("site", None).await.unwrap(), 1);
    for name in ["", "a b", "ä", &"x".repeat(65)] {
        assert!(matches!(library.add_key(name, &[], None).await, Err(LibraryError::Invalid(_))), "{name}");
    }
}
