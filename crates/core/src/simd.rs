//! Run-time dispatch: a loop that the compiler vectorises is compiled a second time for AVX2.

#[cfg(target_arch = "x86_64")]
pub use fearless_simd::{Level, Simd};

/// Defines a function whose body, an `#[inline(always)]` function of the same arguments, also exists for AVX2 and FMA; which of both
/// runs is decided by what the processor has. Both give the same bits: the compiler contracts no multiplication and addition by itself.
#[macro_export]
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis $name:ident, $body:ident, ($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)?) => {
        $(#[$doc])*
        // wasm: a function of its own is made quick while the first run goes on, one that was inlined is not
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
