//! The `tmpi-lab` program, which measures and tests `tmpi`.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
