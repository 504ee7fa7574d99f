// The page for addresses that do not exist.

import { translatePage } from '../i18n/messages.js';

translatePage();
