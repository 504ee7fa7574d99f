//! The `tmpi-lab` program: measures and tests what `tmpi` does.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
