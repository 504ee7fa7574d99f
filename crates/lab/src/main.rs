//! The `tmpi-lab` program, which measures and tests `tmpi`.

fn main() -> std::process::ExitCode {
    tmpi_lab::cli::main()
}
