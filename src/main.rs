//! The `qedgix` binary; everything is in the library.

fn main() -> std::process::ExitCode {
    qedgix::cli::run()
}
