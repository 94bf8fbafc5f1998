//! The `qedgix` binary; everything is in the library.

/// A request of a large fleet is a hundred thousand small allocations.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    qedgix::cli::run()
}
