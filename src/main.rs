//! The `tmpi` program: everything it does lives in the library.
fn main() -> std::process::ExitCode {
    tmpi::cli::main()
}
