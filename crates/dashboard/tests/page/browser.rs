//! The page in a real headless Chromium. `cargo xtask test` runs it where one is installed.

use std::process::{Command, Stdio};

use isodream_dashboard::Guard;

use crate::fixture::{Server, append, media, run};

/// The page as it stands after some seconds, and what the browser's console said.
fn shown(server: &Server, width: u32) -> (String, String) {
    let profile = tempfile::tempdir().unwrap();
    let output = Command::new("chromium")
        .args([
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
        ])
        .arg(format!("--window-size={width},900"))
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .args(["--virtual-time-budget=8000", "--dump-dom"])
        .arg(format!("http://{}/", server.address))
        .stdin(Stdio::null())
        .output()
        .expect("chromium runs; install it, for example with apt install chromium");
    let log = String::from_utf8_lossy(&output.stderr).into_owned();
    let console = log.lines().filter(|line| line.contains("CONSOLE"));
    (
        String::from_utf8_lossy(&output.stdout).into_owned(),
        console.collect::<Vec<_>>().join("\n"),
    )
}

#[test]
#[ignore = "needs Chromium; cargo xtask test runs it where one is installed"]
fn the_page_shows_what_is_there_and_what_comes() {
    let root = tempfile::tempdir().unwrap();
    let first = run(root.path(), "driving/seed-1", 1, 3);
    run(root.path(), "driving/seed-2", 2, 3);
    let server = Server::start(root.path(), Guard::Loopback);

    let (page, console) = shown(&server, 1300);
    assert_eq!(console, "");
    assert!(page.contains(">connected</p>"), "{page}");
    assert!(page.contains("driving/seed-2"), "{page}");
    assert!(page.contains("driving, median of 2 2<"), "{page}");
    assert!(page.contains("<polyline"), "{page}");
    assert!(
        page.contains("id=\"show\" aria-labelledby=\"show-title\" hidden"),
        "{page}"
    );

    append(
        &first,
        "{\"frames\":400,\"time\":1.0,\"eval/score\":90.0}\n",
    );
    media(&first);
    let (page, console) = shown(&server, 390);
    assert_eq!(console, "");
    assert!(
        page.contains("driving, median of 2 24<"),
        "the smoothed newest value moves: {page}"
    );
    assert!(page.contains("Evaluation: return 42.5"), "{page}");
    assert!(page.contains("Attention over the rollout window"), "{page}");
    assert!(
        page.contains("bright where the agent is taken to influence the others: 50% of the steps"),
        "{page}"
    );
    assert!(page.contains("predicted 0.03"), "{page}");
    assert!(
        page.contains("<td>contact</td><td>1</td><td>-1.00</td>"),
        "{page}"
    );
    assert_eq!(page.matches("class=\"probed\"").count(), 6, "{page}");
}
