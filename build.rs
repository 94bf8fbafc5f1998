//! Compiles the protocol files without protoc; the descriptor set feeds gRPC reflection.

use std::path::{Path, PathBuf};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=proto");
    let mut files: Vec<PathBuf> = Vec::new();
    for dir in ["proto/inference", "proto/qedgix/v1"] {
        for entry in std::fs::read_dir(dir)? {
            files.push(entry?.path());
        }
    }
    files.sort();
    files.extend(
        ["v1/dm_env_rpc.proto", "v1/extensions/properties.proto"]
            .map(|file| Path::new("proto/third_party/dm_env_rpc").join(file)),
    );
    // Messages of files, not of a service: reflection does not list them.
    let third_party = protox::compile(["proto/third_party/onnx/onnx.proto"], ["proto/third_party"])?;
    tonic_prost_build::configure().compile_fds(third_party)?;
    let descriptors = protox::compile(files, ["proto/third_party", "proto"])?;
    let out = std::env::var("OUT_DIR")?;
    std::fs::write(Path::new(&out).join("descriptors.bin"), prost::Message::encode_to_vec(&descriptors))?;
    let mut names = prost_build::Config::new();
    // The codec finds the sizes of a message by the name of its type.
    names.enable_type_names();
    let services = tonic_prost_build::configure().bytes(".").codec_path("crate::wire::codec::BoundedCodec");
    services.compile_fds_with_config(descriptors, names)?;
    Ok(())
}
