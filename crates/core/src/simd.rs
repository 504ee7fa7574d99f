//! Run-time dispatch: the compiler compiles and vectorises each such loop twice, for the base target and for AVX2.

#[cfg(target_arch = "x86_64")]
pub use fearless_simd::{Level, Simd};

/// Defines a function with a second version for AVX2 and FMA. The body is an `#[inline(always)]` function with the same arguments; the
/// processor's features select the version at run time. Both versions return the same bits, because the compiler never contracts a
/// multiplication and an addition by itself.
#[macro_export]
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis $name:ident, $body:ident, ($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)?) => {
        $(#[$doc])*
        // never inlined: a wasm engine optimises a separate function during its first run, but not a body inlined into its caller
        #[inline(never)]
        $vis fn $name($($arg: $ty),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            if let Some(avx2) = $crate::simd::Level::new().as_avx2() {
                return $crate::simd::Simd::vectorize(avx2, #[inline(always)] || $body($($arg),*));
            }
            $body($($arg),*)
        }
    };
}

pub use dispatch;
