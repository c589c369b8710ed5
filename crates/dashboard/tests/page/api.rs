//! What is answered, and to whom.

use std::fs;

use isodream_dashboard::Guard;
use serde_json::{Value, json};

use crate::fixture::{Server, append, media, run};

fn parsed((status, body): (u16, String)) -> Value {
    assert_eq!(status, 200, "{body}");
    serde_json::from_str(&body).unwrap()
}

#[test]
fn runs_of_several_seeds_are_found_and_grow() {
    let root = tempfile::tempdir().unwrap();
    let first = run(root.path(), "driving/seed-1", 1, 3);
    run(root.path(), "driving/seed-2", 2, 2);
    run(root.path(), "other", 0, 0);
    fs::create_dir(root.path().join("empty")).unwrap();
    fs::write(
        first.join("evaluation.json"),
        r#"{"policies":{"trained":{"return_mean":4.5,"return_std":1.0,"collisions_mean":null}}}"#,
    )
    .unwrap();
    let server = Server::start(root.path(), Guard::Loopback);

    let overview = parsed(server.get("/api/runs"));
    let runs = overview["runs"].as_array().unwrap();
    let found = |id: &str| runs.iter().find(|run| run["id"] == id).unwrap();
    assert_eq!(runs.len(), 3);
    assert_eq!(overview["live"], false);
    assert_eq!(
        found("driving/seed-1")["group"],
        found("driving/seed-2")["group"]
    );
    assert_eq!(found("driving/seed-1")["frames"], 300.0);
    assert_eq!(
        found("driving/seed-1")["evaluation"]["trained"]["return_mean"],
        4.5
    );
    assert_eq!(found("driving/seed-2")["evaluation"], json!({}));
    assert_eq!(found("other")["metrics"], json!([]));

    let series = "/api/series?run=driving%2Fseed-1&metric=eval%2Fscore";
    assert_eq!(
        parsed(server.get(series))["points"],
        json!([[100.0, 1.0], [200.0, 2.0], [300.0, 3.0]])
    );
    append(
        &first,
        "{\"frames\":400,\"time\":1.0,\"eval/score\":7.0}\n{\"frames\":500,\"eval",
    );
    assert_eq!(parsed(server.get(series))["points"][3], json!([400.0, 7.0]));
    assert_eq!(server.get("/api/series?run=nothing&metric=x").0, 404);
}

#[test]
fn a_run_directory_itself_is_a_run() {
    let root = tempfile::tempdir().unwrap();
    let this = run(root.path(), "this", 0, 1);
    let server = Server::start(&this, Guard::Loopback);
    assert_eq!(parsed(server.get("/api/runs"))["runs"][0]["id"], ".");
    assert_eq!(
        parsed(server.get("/api/live")),
        json!({"learner": null, "replay": []})
    );
}

#[test]
fn media_are_listed_and_served_in_parts() {
    let root = tempfile::tempdir().unwrap();
    let folder = run(root.path(), "a", 0, 1);
    let server = Server::start(root.path(), Guard::Loopback);
    assert_eq!(
        parsed(server.get("/api/media?run=a")),
        json!({"episode": [], "open_loop": [], "probe": []})
    );
    media(&folder);
    assert_eq!(
        parsed(server.get("/api/media?run=a")),
        json!({"episode": [300], "open_loop": [200], "probe": [300]})
    );
    let facts = parsed(server.get("/api/file?run=a&name=episode-0000000300.json"));
    assert_eq!(facts["score"], 42.5);

    let host = server.address.to_string();
    let path = "/api/file?run=a&name=episode-0000000300.mp4";
    let (status, head, all) = server.ask(path, &[("Host", &host)]);
    assert_eq!(status, 200);
    assert!(head.contains("content-type: video/mp4"), "{head}");
    let (status, head, part) = server.ask(path, &[("Host", &host), ("Range", "bytes=4-11")]);
    assert_eq!((status, &part[..]), (206, &all[4..12]), "{head}");
}

#[test]
fn nothing_else_of_the_disk_is_served() {
    let root = tempfile::tempdir().unwrap();
    let folder = run(root.path(), "a", 0, 1);
    media(&folder);
    fs::write(root.path().join("secret"), "x").unwrap();
    let server = Server::start(&folder, Guard::Loopback);
    for query in [
        "run=.&name=../config.toml",
        "run=.&name=..%2Fconfig.toml",
        "run=..&name=episode-0000000300.mp4",
        "run=../a&name=episode-0000000300.mp4",
        "run=%2Fetc&name=episode-0000000300.json",
        "run=./../a&name=episode-0000000300.mp4",
        "run=&name=episode-0000000300.mp4",
        "run=.&name=episode-0000000300.mp4%00.json",
    ] {
        assert_eq!(server.get(&format!("/api/file?{query}")).0, 404, "{query}");
    }
    assert_eq!(server.get("/../secret").0, 404);
    assert_eq!(
        server.get("/api/file?run=.&name=episode-0000000300.mp4").0,
        200
    );
}

#[test]
fn a_page_elsewhere_cannot_look_at_a_dashboard_on_loopback() {
    let root = tempfile::tempdir().unwrap();
    let server = Server::start(root.path(), Guard::Loopback);
    let (status, _, body) = server.ask("/api/runs", &[("Host", "evil.example")]);
    assert_eq!(status, 403, "{}", String::from_utf8_lossy(&body));
    let (status, head, _) = server.ask("/", &[("Host", "localhost:1")]);
    assert_eq!(status, 200);
    assert!(
        head.contains("content-security-policy: default-src 'none'"),
        "{head}"
    );
    assert!(!head.contains("access-control-allow-origin"), "{head}");
}

#[test]
fn a_token_is_asked_for_and_kept_in_a_cookie() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("token");
    fs::write(&file, "0123456789abcdef\n").unwrap();
    let everywhere = "0.0.0.0:7080".parse().unwrap();
    let guard = Guard::new(everywhere, Some(&file), false).unwrap();
    let server = Server::start(root.path(), guard);
    let status = |path: &str, headers: &[(&str, &str)]| {
        server.ask(path, &[&[("Host", "x")], headers].concat()).0
    };
    assert_eq!(status("/api/runs", &[]), 401);
    assert_eq!(status("/?token=0123456789abcdeF", &[]), 401);
    assert_eq!(
        status("/api/runs", &[("Cookie", "isodream_token=wrong")]),
        401
    );
    assert_eq!(
        status("/api/runs", &[("Authorization", "Bearer 0123456789abcdef")]),
        200
    );

    let (status_code, head, _) = server.ask("/?token=0123456789abcdef", &[("Host", "x")]);
    assert_eq!(status_code, 303);
    assert!(
        head.contains("location: /\r\n"),
        "the token leaves the address: {head}"
    );
    let cookie = head
        .lines()
        .find(|line| line.starts_with("set-cookie: "))
        .unwrap();
    assert!(
        cookie.contains("httponly") && cookie.contains("samesite=strict"),
        "{cookie}"
    );
    assert_eq!(
        status(
            "/api/runs",
            &[("Cookie", "a=b; isodream_token=0123456789abcdef")]
        ),
        200
    );
    assert_eq!(
        status(
            "/api/runs",
            &[
                ("Cookie", "isodream_token=of-yesterday"),
                ("Authorization", "Bearer 0123456789abcdef")
            ]
        ),
        200,
        "an old cookie does not stand in the way"
    );

    let (_, head, _) = server.ask("/?token=0123456789abcdef", &[("Host", "x:7080")]);
    assert!(
        head.contains("set-cookie: isodream_token_7080="),
        "each port has its own: {head}"
    );
    let kept = ("Cookie", "isodream_token_7080=0123456789abcdef");
    let at = |host: &str| server.ask("/api/runs", &[("Host", host), kept]).0;
    assert_eq!((at("x:7080"), at("x:7081")), (200, 401));
}
