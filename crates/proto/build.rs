//! Compiles `/proto` with protox, so that no `protoc` is needed.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=../../proto");
    let files = protox::compile(
        [
            "isodream/v1/common.proto",
            "isodream/v1/replay.proto",
            "isodream/v1/learner.proto",
            "isodream/v1/environment.proto",
        ],
        ["../../proto"],
    )?;
    tonic_prost_build::configure()
        .bytes(".isodream.v1")
        .compile_fds(files)?;
    Ok(())
}
