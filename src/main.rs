//! The `qedgix` binary. All code is in the library.

/// Requests of large fleets make about 100 000 small allocations, which mimalloc serves faster than the system allocator.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    qedgix::cli::run()
}
